"""The CAs of a keystore: making them, opening their keys, taking over CAs that exist."""
