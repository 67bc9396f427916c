"""The programs that the demo starts: its nodes on rclpy and on Cyclone DDS."""
