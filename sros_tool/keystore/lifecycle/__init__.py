"""The life cycle of a keystore: creation, renewal, revocation, and rotation of its CAs."""
