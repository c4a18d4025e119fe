"""Scans and captures in the layouts of public data sets."""
