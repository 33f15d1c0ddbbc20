"""The ROS nodes: parameters and topics, nothing else."""
