"""From a few frames to a pose: its covariance, its evidence, and a picture to look at."""

import sys
from pathlib import Path

import numpy as np

import placegraph as pg

world = Path(sys.argv[1] if len(sys.argv) > 1 else "demo-out/world")  # left by `placegraph demo`
scene = pg.open_map(world / "altbau.scene")  # made by 04_build_from_glb.py
walk = pg.open_capture(world / "walk")
print(walk)

pose = scene.localize(walk[:8], seed=0)
print(f"{pose.status}: {pose.reason}")
if pose.status is pg.Status.OK:
    x, y, z, yaw = pose.best.pose
    sigma = np.sqrt(pose.best.covariance.diagonal())
    print(f"x {x:.2f} m, y {y:.2f} m, z {z:.2f} m, yaw {np.degrees(yaw):.1f}°")
    print("deviation of x, y, z in mm:", np.round(1000 * sigma[:3], 1))
    print(pose.refinement.reason, f"It moved the pose by {pose.refinement.stats['shift_m']:.3f} m.")
for e in pose.evidence[:5]:
    print(f"{e.verdict:>8} {e.weight:+6.1f} nat  {e.statement} {e.note}")

seen = scene.render(pose.best.map_from_camera, walk.camera)
print("the map at the middle of the image:", scene.graph.labels[seen.objects[90, 160]])
