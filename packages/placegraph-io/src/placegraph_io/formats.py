"""Formats of captures that placegraph-io reads, in the order in which they are tried."""

from __future__ import annotations

from placegraph.io.formats import Format

_DATASET, _PHONE = "placegraph_io.dataset.", "placegraph_io.phone"
FORMATS = (
    Format("TUM RGB-D", "rgb.txt, depth.txt and groundtruth.txt", f"{_DATASET}tum_rgbd", "tum_rgbd",
           ("poses",)),
    Format("Stray Scanner", "rgb.mp4, odometry.csv and camera_matrix.csv", _PHONE, "stray"),
    Format("Polycam", "keyframes/ with images/, cameras/ and depth/", _PHONE, "polycam"),
    Format("Record3D", "metadata.json and rgbd/ or rgb/ and depth/, or .r3d", _PHONE, "record3d"),
    Format("MultiScan", "X.jsonl and X.mp4", f"{_DATASET}multiscan", "multiscan"),
    Format("ios_logger", "Frames.m4v, Frames.txt and ARposes.txt", _PHONE, "ios_logger"),
    Format("3D Scanner App", "frame_00000.json and .jpg", _PHONE, "arkit_app"),
    Format("ARKitScenes", "lowres_wide.traj and lowres_wide/", f"{_DATASET}arkit_scenes", "arkit_scenes"),
    Format("3RScan", "sequence/ with _info.txt, or sequence.zip", f"{_DATASET}scan3r_sequence",
           "scan3r_sequence"),
    Format("ScanNet", "a .sens file, or a folder with one", f"{_DATASET}sens", "sens",
           ("labels", "label_column", "partial")),
    Format("ScanNet's exporter", "color/, pose/ and intrinsic_color.txt", f"{_DATASET}sens",
           "scannet_export", ("labels", "label_column")),
    Format("HoloLens 2's StreamRecorder", "*_pv.txt, PV/ and Depth Long Throw/", f"{_DATASET}hololens",
           "hololens"),
    Format("COLMAP", "cameras, images and points3D (.bin or .txt), in sparse/0 or the folder itself",
           f"{_DATASET}colmap", "colmap", ("scale", "up")),
    Format("RTAB-Map", "a .db file", f"{_DATASET}rtabmap", "rtabmap"),
    Format("NeRFCapture, Spectacular AI and nerfstudio", "transforms.json", f"{_DATASET}transforms",
           "transforms", ("scale", "up")),
    Format("a bag of ROS", ".mcap, .db3, .bag, or a folder of rosbag2", "placegraph_io.ros.capture",
           "bag", ("poses", "topics"), rank=3),
)  # fmt: skip
