"""The decisions of DDS: who may join, publish and subscribe, by vendor, and why.

`documents` reads the governance and permissions, `vendors` declares the rules, `access` decides.
The rules follow the vendors' code and were compared with the decisions of Fast DDS 2.9.1 and 2.14.5
and of Cyclone DDS 0.10.2; a vendor that was never tested is assumed to follow the standard.
"""
