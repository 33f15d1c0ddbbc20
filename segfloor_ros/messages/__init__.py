"""NumPy to ROS messages and back, QoS profiles."""
