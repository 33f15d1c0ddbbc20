"""The five ROS 2 nodes: parameters and topics around the stages."""
