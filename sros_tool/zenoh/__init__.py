"""The language of Zenoh: key expressions, access control and configurations."""
