"""Captures of phone apps."""
