"""Conversions between NumPy data and ROS 2 messages, topics and their quality of service.

In: arrays and types of `core.contracts`, or messages. Out: the other one; a message that cannot be
read is an error that names its topic. The way in is `topics`, and a module per kind of message.
"""
