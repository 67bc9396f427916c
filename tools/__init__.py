"""The commands of `./dev`: set up a checkout with only Python's standard library, and run it."""
