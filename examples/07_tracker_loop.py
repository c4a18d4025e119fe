"""A robot's loop: one frame at a time, made of arrays; a pose whenever it is known."""

import sys
from pathlib import Path

import placegraph as pg

world = Path(sys.argv[1] if len(sys.argv) > 1 else "demo-out/world")  # left by `placegraph demo`
scene = pg.open_map(world / "altbau.scene")  # made by 04_build_from_glb.py
recorded = pg.open_capture(world / "walk")  # stands for the robot's camera

tracker = scene.tracker(recorded.camera, seed=0)
for shot in recorded[:10]:
    frame = pg.Frame.from_arrays(
        shot.rgb(),  # (H, W, 3) uint8
        shot.camera,  # width, height, fx, fy, cx, cy, distortion
        depth=shot.depth(),  # (h, w) along the optical axis [m], or None
        odometry=shot.odometry,  # (4, 4) odometry_from_camera
        gravity=shot.gravity,  # (3,) down, in the camera's axes
        stamp=shot.stamp,
    )
    estimate = tracker.update(frame)
    if estimate.status is pg.Status.OK:
        x, y, z, _ = estimate.best.pose
        print(f"{shot.stamp:5.2f} s  {x:.2f} {y:.2f} {z:.2f}")
    else:
        print(f"{shot.stamp:5.2f} s  {estimate.status}")
