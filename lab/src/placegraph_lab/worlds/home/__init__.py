"""Homes made up from seeds."""
