"""Named findings about policies, keystores and the environment of processes.

A check is a function from values to findings; nothing here repairs anything, prints, or asks the
clock.  `sros_tool.checks.kind` has all kinds of findings.
"""
