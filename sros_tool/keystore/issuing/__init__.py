"""Issuing by the CAs of a keystore: their keys, what they sign, and the proof of permissions."""
