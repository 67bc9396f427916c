"""Keystores on disk: their layout, reading them, changing them, and delivery to robots."""
