"""The isolation demo: scenarios, nodes, runner, capture and verdict."""
