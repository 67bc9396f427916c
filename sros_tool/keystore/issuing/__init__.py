"""Issuing certificates and permissions for enclaves, and proving that permissions fit policies."""
