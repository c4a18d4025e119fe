"""Frames, cameras and odometry: captures in every plain layout."""
