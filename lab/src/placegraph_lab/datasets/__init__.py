"""Readers of data sets that only experiments need, and their lists of pairs."""
