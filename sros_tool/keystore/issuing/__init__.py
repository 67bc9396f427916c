"""Issuing for enclaves: certificates, permissions, their proof and the ledger."""
