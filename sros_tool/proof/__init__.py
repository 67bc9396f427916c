"""Proofs about policies and keystores, for all names: what a change adds."""
