"""The live ROS graph: observe it, and learn from it the policy under which the robot works."""
