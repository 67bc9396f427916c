"""Delivery of enclaves to robots: exports, signing requests, and the answers to them."""
