"""Localization for robots: messages of ROS, and the bags, viewers and nodes that carry them."""
