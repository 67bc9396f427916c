"""Atomic changes of a keystore: stage, commit, recovery."""
