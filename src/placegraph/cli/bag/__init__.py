"""Commands on bags of ROS."""
