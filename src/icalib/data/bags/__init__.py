"""Bag files of ROS 1 and ROS 2 -> their messages, as bytes, in the order in which they were written."""
