"""Conversions between NumPy data and ROS 2 messages, topics and their quality of service."""
