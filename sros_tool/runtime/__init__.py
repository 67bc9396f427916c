"""Which DDS stacks are here, what they enforce, and the environment of a secured process."""
