"""Thin ROS shells: parameters to validated settings, topics to calls of the core."""
