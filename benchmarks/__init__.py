"""Measures sros side by side with the floor of each task, in the same run."""
