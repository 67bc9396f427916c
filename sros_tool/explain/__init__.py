"""Explanations: of DDS decisions, of the reach of an enclave, and of vendors' logs."""
