"""The tables by name: what each measures, its options, rows and columns, and the papers' figures."""

NUMBERED = {"sg2loc": 14}
"""Modules with several tables, which are called `sg2loc-1` and so on, and how many."""
