"""Poses: filter, refinement, matchers, speed."""
