"""Likelihood of statements at viewpoints: `query` compiles a description, kernels score it."""
