"""The live ROS graph: observe it, and learn the policy that the robot needs."""
