"""What DDS decides: who may join, publish and subscribe, by vendor, and why.

`access` decides, by the rules that `vendors` declares, on documents as `documents` reads them.
The rules follow the vendors' code and were compared with what Fast DDS 2.9.1 and 2.14.5 and
Cyclone DDS 0.10.2 really do; a vendor that was never measured decides by the standard.
"""
