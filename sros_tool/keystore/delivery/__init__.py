"""Bringing enclaves to robots: export, signing request, answer, import."""
