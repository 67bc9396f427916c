"""Findings in policies."""
