"""Benchmarks of sros, each next to the floor of its task, measured in the same run.

The floor is the time of the unavoidable work, such as the same cryptography and files alone.
"""
