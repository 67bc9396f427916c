"""Closing an open robot: watching, preparing and applying security, proving it, undoing it.

The steps are verbs of sros, which the caller runs (`Shell`); nothing is printed here.
"""
