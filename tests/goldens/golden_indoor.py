"""Windows of frames, trackers, changes and libraries, and what scene maps answer."""

from dataclasses import replace

import numpy as np
from golden_answers import (
    changes,
    findings,
    fingerprint,
    pose_estimate,
    scene_content,
    scene_estimate,
)
from golden_worlds import home_scene

import placegraph as pg

COARSE = {"refine": False}
SENTENCES = (
    "a kitchen with two sinks",
    "a bedroom with a bed and a wardrobe",
    "a bathroom with a washing machine",
    "an office with a whiteboard",
    "a fridge next to a window, and a sofa in front of a TV",
    "a swimming pool with a diving board",
)


def few(worlds):
    """The house, and a window of each kind: what every run of the tests compares."""
    house, file = worlds.scene("house")
    yield "map", scene_content(house) | {"kB": file.stat().st_size / 1e3}
    for name, capture, options in (
        ("labels", worlds.capture(2)[10:12], COARSE),
        ("one frame", worlds.capture(5)[7:8], COARSE),
        ("no labels", worlds.capture(3, labels=None)[4:7], COARSE),
        ("looks", worlds.capture(0, labels=None)[12:14], COARSE | {"encoder": "appearance"}),
        ("told", worlds.capture(4)[3:4], COARSE | {"description": "I see a fridge."}),
        ("refined", worlds.capture(2)[10:13], {}),
    ):
        yield name, pose_estimate(house.localize(capture, seed=0, **options))
    yield "render", rendered(house, worlds.capture(0)[3])


def windows(worlds):
    """Names, captures and options of windows of the house."""
    at = lambda s, n: slice((3 * s + 2 * n) % 18, (3 * s + 2 * n) % 18 + n)  # noqa: E731
    for s in range(8):
        for n in (1, 2, 3, 5):
            yield f"labels {s} {n}", worlds.capture(s)[at(s, n)], COARSE
        blind = worlds.capture(s, labels=None)
        yield f"no labels {s}", blind[at(s, 5)], COARSE
        yield f"refined {s}", worlds.capture(s)[at(s, 3)], {"seed": s}
        yield f"looks {s}", blind[at(s, 2)], COARSE | {"encoder": "appearance"}
    for s in range(0, 8, 2):
        yield f"classes {s}", worlds.classes(s)[at(s, 2)], COARSE
        said = ("I am next to the sofa.", "I see a fridge. I am facing the window.")[s // 2 % 2]
        yield f"told {s}", worlds.capture(s)[at(s, 1)], COARSE | {"description": said}
        coarse = COARSE | {"options": pg.FilterOptions.coarse()}
        yield f"coarse {s}", worlds.capture(s)[at(s, 3)], coarse
    for s, only in ((1, {"depth": True}), (3, {"colour": True}), (6, {"semantic": True})):
        options = pg.PoseSearchOptions().only(**only)
        yield f"only {next(iter(only))}", worlds.capture(s)[at(s, 3)], {"options": options}
    for s in (0, 7):
        paper = COARSE | {"options": pg.FilterOptions.paper()}
        yield f"paper {s}", worlds.capture(s)[at(s, 2)], paper
        x, y, z = worlds.truth(s)[at(s, 2)].odometry[0, :3, 3]
        prior = pg.Prior(x + 0.4, y - 0.3, z=z, spread=0.8)
        yield f"prior {s}", worlds.capture(s)[at(s, 2)], COARSE | {"prior": prior}
    pnp = {"refine": pg.RefineOptions.paper(), "matcher": "guided"}
    yield "refined as in the paper", worlds.capture(4)[5:7], pnp
    yield "sift", worlds.capture(2, labels=None)[9:12], {"matcher": "sift"}


def house(worlds):
    """The house from all sides: windows, refinement from known poses, a tracker, a merged map."""
    scene, _ = worlds.scene("house")
    for name, capture, options in windows(worlds):
        yield name, pose_estimate(scene.localize(capture, **{"seed": 0} | options), 2)
    for s in (1, 5, 6):
        start = worlds.truth(s)[8].odometry.copy()
        start[:3, 3] += (0.1, -0.08, 0.05)
        yield f"known {s}", pose_estimate(scene.refine(worlds.capture(s)[6:9], start))
    for s, labels in ((0, "auto"), (3, None)):
        capture = worlds.capture(s, labels=labels)
        tracker = scene.tracker(capture.camera, seed=1)
        told = [pose_estimate(tracker.update(frame), 1) for frame in capture[:10]]
        yield f"tracker {s}", told[2::3]
    home = home_scene(1)
    merged = pg.merge_scenes({"home": home, "house": scene})
    for shares in (None, (0.3, 0.7)):
        estimate = merged.localize(worlds.capture(1)[4:6], shares=shares, refine=False, seed=0)
        yield f"merged {shares}", pose_estimate(estimate)


def rendered(scene, frame):
    """The map as the camera of a frame sees it, from a pose in the middle of the house."""
    pose = np.eye(4)
    pose[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    pose[:3, 3] = scene.bounds.mean(axis=0)
    seen = scene.render(pose, frame.camera.resize(160, 90))
    told = {"objects": np.unique(seen.objects).tolist()}
    for column in ("colour", "depth", "points"):  # a pixel may differ by one, so not exactly
        told[column] = fingerprint(getattr(seen, column).astype(float))
    return told


def maps(worlds):
    """Built maps, what is wrong with them, what changed in them, and what is written of them."""
    for name in ("house", "small", "office"):
        scene, file = worlds.scene(name)
        yield f"{name} map", scene_content(scene) | {"kB": file.stat().st_size / 1e3}
        yield f"{name} check", {"found": findings(scene)}
    yield "home", scene_content(home_scene(3))
    scene, _ = worlds.scene("house")
    for s in (2, 5):
        capture = worlds.capture(s)
        diff = scene.diff(capture[::3], worlds.truth(s)[::3].odometry)
        yield f"diff {s}", changes(diff)
        newer = scene.updated(diff, when="2026-11-22")
        yield f"updated {s}", scene_content(newer)
        yield f"diff of maps {s}", changes(scene.diff(newer))
    for suffix in ("glb", "ply", "json"):
        files = scene.export(worlds.folder / f"house.{suffix}", overwrite=True)
        yield f"export {suffix}", {f.name: {"kB": f.stat().st_size / 1e3} for f in files}


def office(worlds):
    """A real walk in the map of its first half: windows, and a way that is tracked."""
    scene, _ = worlds.scene("office")
    capture = worlds.office()
    for i, first in enumerate(range(190, 360, 9)):
        options = {} if i % 4 == 3 else COARSE
        estimate = scene.localize(capture[first : first + 10 : 2], seed=i, **options)
        yield f"{first}", pose_estimate(estimate, 2)
    yield "way", pose_estimate(scene.localize(capture[186:260:2], seed=0))


def library(worlds):
    """Which of a handful of scenes frames or a sentence belong to."""
    shelf = pg.SceneLibrary()
    for name in ("house", "office"):
        shelf.add(name, worlds.scene(name)[1])
    for seed in range(6):
        shelf.add(f"home{seed}", worlds.home(seed))
    shelf.save(worlds.folder / "some.library")
    yield "file", {"kB": (worlds.folder / "some.library").stat().st_size / 1e3}
    shelf = pg.open_map(worlds.folder / "some.library")
    walks = {f"house {s}": worlds.capture(s)[4:14:2] for s in range(8)}
    walks |= {f"office {i}": worlds.office()[i : i + 20 : 4] for i in (190, 230, 270, 310)}
    cosines = replace(pg.SearchOptions(), method="cosines")
    for name, capture in walks.items():
        yield name, scene_estimate(shelf.search(capture))
        yield f"{name}, cosines", scene_estimate(shelf.search(capture, options=cosines))
    for text in SENTENCES:
        yield text, scene_estimate(shelf.search(text))
    both = shelf.search(walks["house 1"], description=SENTENCES[0])
    yield "frames and a sentence", scene_estimate(both)
    for name in ("house 2", "office 230"):
        yield f"pose of {name}", pose_estimate(shelf.localize(walks[name], refine=False, seed=0))
    by_looks = pg.SceneLibrary("appearance")
    for name in ("house", "office"):
        by_looks.add(name, worlds.scene(name)[0])
    yield "by looks", scene_estimate(by_looks.search(walks["office 230"]))


GROUPS = {"few": few, "maps": maps, "house": house, "office": office, "library": library}
