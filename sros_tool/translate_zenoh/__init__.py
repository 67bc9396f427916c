"""Translation between ROS and Zenoh: `rights` as access control, and the tokens of the `graph`."""
