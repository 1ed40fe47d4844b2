"""Readers of ROS messages that several kinds of sensors use."""
