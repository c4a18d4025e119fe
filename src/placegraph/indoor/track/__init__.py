"""Frames and odometry as they come: a pose followed, lost and found again, and told at any time."""
