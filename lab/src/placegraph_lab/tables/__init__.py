"""Protocols, metrics and tables; never imported by the wings."""
