"""What DDS will decide and why, whom an enclave can influence, and what a vendor's log means."""
