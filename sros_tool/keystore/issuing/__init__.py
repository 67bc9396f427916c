"""Issue files with the CAs of a keystore: CA keys, signed files, and the proof of permissions."""
