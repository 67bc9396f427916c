"""CA rotation: the stages, and the state of a keystore in between."""
