"""The language of DDS Security: domains, governance, permissions, and their XML."""
