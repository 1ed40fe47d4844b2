"""Readers of bag files of ROS 1 and ROS 2: serialized messages in the order in which they were written."""
