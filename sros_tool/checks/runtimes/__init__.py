"""Findings in the environment of a process, and in the processes that run."""
