"""Bags of ROS 1 and ROS 2, read without ROS: captures are made of them by `bag.read_bag`."""
