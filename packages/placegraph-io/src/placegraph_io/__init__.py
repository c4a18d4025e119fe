"""Readers of other people's formats: data sets, phones, ROS bags, scene graphs, Overture."""
