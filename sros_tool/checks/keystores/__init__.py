"""Findings in keystores."""
