"""Rays, scores and renderings on a CUDA device, by NVIDIA Warp."""
