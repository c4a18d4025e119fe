"""Formats of captures that placegraph-io reads, in the order in which they are tried."""

from __future__ import annotations

from placegraph.io.formats import Format

FORMATS = (
    Format(
        "TUM RGB-D",
        "rgb.txt, depth.txt and groundtruth.txt",
        "placegraph_io.dataset.tum_rgbd",
        "tum_rgbd",
        ("poses",),
    ),
    Format(
        "Stray Scanner",
        "rgb.mp4, odometry.csv and camera_matrix.csv",
        "placegraph_io.phone",
        "stray",
    ),
    Format(
        "Polycam", "keyframes/ with images/, cameras/ and depth/", "placegraph_io.phone", "polycam"
    ),
    Format(
        "Record3D",
        "metadata.json and rgbd/ or rgb/ and depth/, or .r3d",
        "placegraph_io.phone",
        "record3d",
    ),
    Format("MultiScan", "X.jsonl and X.mp4", "placegraph_io.dataset.multiscan", "multiscan"),
    Format(
        "ios_logger", "Frames.m4v, Frames.txt and ARposes.txt", "placegraph_io.phone", "ios_logger"
    ),
    Format("3D Scanner App", "frame_00000.json and .jpg", "placegraph_io.phone", "arkit_app"),
    Format(
        "ARKitScenes",
        "lowres_wide.traj and lowres_wide/",
        "placegraph_io.dataset.arkit_scenes",
        "arkit_scenes",
    ),
    Format(
        "3RScan",
        "sequence/ with _info.txt, or sequence.zip",
        "placegraph_io.dataset.scan3r_sequence",
        "scan3r_sequence",
    ),
    Format(
        "ScanNet",
        "a .sens file, or a folder with one",
        "placegraph_io.dataset.sens",
        "sens",
        ("labels", "label_column", "partial"),
    ),
    Format(
        "ScanNet's exporter",
        "color/, pose/ and intrinsic_color.txt",
        "placegraph_io.dataset.sens",
        "scannet_export",
        ("labels", "label_column"),
    ),
    Format(
        "COLMAP",
        "cameras, images and points3D (.bin or .txt), in sparse/0 or the folder itself",
        "placegraph_io.dataset.colmap",
        "colmap",
        ("scale", "up"),
    ),
    Format("RTAB-Map", "a .db file", "placegraph_io.dataset.rtabmap", "rtabmap"),
    Format(
        "NeRFCapture, Spectacular AI and nerfstudio",
        "transforms.json",
        "placegraph_io.dataset.transforms",
        "transforms",
        ("scale", "up"),
    ),
    Format(
        "a bag of ROS",
        ".mcap, .db3, .bag, or a folder of rosbag2",
        "placegraph_io.ros.capture",
        "bag",
        ("poses", "topics"),
        rank=3,
    ),
)
