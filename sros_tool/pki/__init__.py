"""Keys, certificates, revocation lists and S/MIME signatures, without access to files."""
