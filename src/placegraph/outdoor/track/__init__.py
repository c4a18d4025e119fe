"""Sentences along a walk."""
