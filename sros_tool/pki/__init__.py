"""Keys, certificates and S/MIME signatures: bytes in, bytes out."""
