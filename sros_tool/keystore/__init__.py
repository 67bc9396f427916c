"""The keystore on disk: its layout, reading it, changing it, and sending parts of it to robots."""
