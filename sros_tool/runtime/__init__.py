"""The installed DDS stacks, what they enforce, and the environment of a secured process."""
