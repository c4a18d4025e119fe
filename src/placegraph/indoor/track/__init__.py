"""Tracking of a camera by frames and odometry, offline and live, with relocalization."""
