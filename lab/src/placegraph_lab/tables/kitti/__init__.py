"""KITTI360Pose."""
