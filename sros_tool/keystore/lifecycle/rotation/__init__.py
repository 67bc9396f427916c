"""CA rotation: its state and its stages."""
