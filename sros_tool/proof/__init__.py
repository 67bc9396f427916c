"""Proofs about policies and keystores, for all names: requirements, and what a change adds."""
