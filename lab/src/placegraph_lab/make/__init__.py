"""Makers of the files that ship with placegraph: lexicons, decoys, demo, kernels, mean appearance."""
