"""Closing an open robot: watching it, preparing and applying its security, the proof, the way back.

The steps are verbs of sros, which the caller runs (`Shell`); nothing is printed here.
"""
