from types import SimpleNamespace

import numpy as np

import placegraph as pg
from placegraph.core.geometry import Camera
from placegraph.indoor.build import build_scene
from placegraph.io.capture.tum import read_tum
from placegraph_lab.worlds.bags import BASE_FROM_CAMERA, BagWriter, Layout, write_capture
from placegraph_lab.worlds.flat.walks import stroll, write_walk

START = Layout().start
FRAMES = 12


def made(folder, study):
    rng = np.random.default_rng(3)
    interior = study.furnish(rng)
    scene = build_scene(interior.write_glb(folder / "room.glb"), folder / "room.scene")
    walk = stroll(study, rng, frames=FRAMES, through="1231")
    camera = Camera(160, 90, 115.0, 115.0, 80.0, 45.0)
    write_walk(interior, walk, folder / "walk", rng, camera=camera, labels=None)
    truth = read_tum(folder / "walk" / "trajectory.tum").poses
    for name in ("gravity.txt", "trajectory.tum"):
        (folder / "walk" / name).unlink(missing_ok=True)
    clip = pg.open_capture(folder / "walk")
    write_bag(folder / "bag.mcap", clip)
    return SimpleNamespace(
        folder=folder, scene=scene, map=folder / "room.scene", walk=folder / "walk",
        bag=folder / "bag.mcap", clip=clip, truth=truth,
    )  # fmt: skip


def write_bag(path, clip, between=5):
    folder = path.with_suffix("")
    with BagWriter(folder) as writer:
        camera_from_base = np.linalg.inv(BASE_FROM_CAMERA)
        for before, after in zip(clip.frames[:-1], clip.frames[1:], strict=True):
            for part in np.arange(between) / between:
                pose = before.odometry.copy()
                pose[:3, 3] += part * (after.odometry - before.odometry)[:3, 3]
                stamp = START + before.stamp + part * (after.stamp - before.stamp)
                writer.odometry("/odom", stamp, pose @ camera_from_base)
        last = clip.frames[-1]
        writer.odometry("/odom", START + last.stamp, last.odometry @ camera_from_base)
        write_capture(writer, clip, Layout(poses="none"))
    (folder / f"{folder.name}.mcap").rename(path)
    return path


def off(pose, truth):
    turn = np.clip((np.trace(pose[:3, :3].T @ truth[:3, :3]) - 1) / 2, -1, 1)
    return float(np.linalg.norm(pose[:3, 3] - truth[:3, 3])), float(np.arccos(turn))
