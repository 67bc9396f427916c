"""Reading the Zenoh configurations of a keystore: those that it has, and those that it needs."""
