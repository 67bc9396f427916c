"""Atomic changes of many files of a keystore: staging, commit and recovery."""
