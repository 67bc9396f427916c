"""The agent of a robot: it fetches the robot's release, installs it, and reports what runs."""
