"""Conversions between NumPy data and ROS 2 messages, quality of service, and joining by stamp."""
