"""What `./dev` does: sets up a checkout with Python's standard library alone, then runs it."""
