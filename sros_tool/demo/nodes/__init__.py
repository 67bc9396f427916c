"""The nodes of the demo: rclpy and Cyclone DDS."""
