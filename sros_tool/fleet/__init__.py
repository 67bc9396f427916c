"""The robots of a fleet, and one policy for all of them."""
