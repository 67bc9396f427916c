"""The CAs of a keystore: creating them, opening their keys, importing existing CAs."""
