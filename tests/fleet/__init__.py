"""Tests of the fleet: its files, its robots and their policy."""
