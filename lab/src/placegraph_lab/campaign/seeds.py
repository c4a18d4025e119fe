"""Sound captures, scans and bags of every layout that is read, small: what is mutated.

They are drawn by the writers of the repository's tests, so that no layout is written twice.
"""

from __future__ import annotations

import importlib
import shutil
import sys
import zipfile
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image

from placegraph.core.geometry import Camera
from placegraph.io.capture.frame import Capture, Frame
from placegraph.io.capture.tum import write_tum
from placegraph_lab.worlds.bags import BagWriter, Layout, write_capture

Draw = Callable[[Path, "Drawn"], None]


ROOT = Path(__file__).parents[4]  # of the repository: tests stand beside the lab
LARGE = Camera(192, 144, 160.0, 161.0, 97.5, 71.0)  # A video's blocks blur small images


def writer(name: str) -> Any:  # noqa: ANN401  # a module
    """Module of the repository's tests."""
    if str(ROOT) not in sys.path:
        sys.path.insert(0, str(ROOT))
    return importlib.import_module(f"tests.{name}")


def save(path: Path, array: ArrayLike, **options: Any) -> None:  # noqa: ANN401
    """Write an image, with its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(array)).save(path, **options)


class Drawn:
    """What seeds are made of, drawn once: films of a room as telephones hold them."""

    @cached_property
    def world(self) -> Any:  # noqa: ANN401  # of the tests
        """Three frames of 96 x 72 with depth."""
        return self._recorded(frames=3)

    @cached_property
    def large(self) -> Any:  # noqa: ANN401
        """The same for videos."""
        return self._recorded(frames=3, camera=LARGE, shrink=4)

    def _recorded(self, **options: Any) -> Any:  # noqa: ANN401
        from placegraph_lab.worlds.flat.flat import Flat

        study = Flat.parse(writer("conftest").STUDY)
        return writer("formats.conftest").Recorded(study, **options)

    @cached_property
    def clip(self) -> Capture:
        """The film as a capture in memory."""
        world = self.world
        return Capture.from_frames(
            Frame.from_arrays(
                world.rgb[i], world.cameras[i], depth=np.where(world.sure[i], world.metres[i], 0),
                depth_camera=world.depth_cameras[i], odometry=world.poses[i],
                stamp=world.stamps[i],
            )
            for i in range(len(world))
        )  # fmt: skip


def _phone(name: str, *, large: bool = False, saves: bool = True, **options: Any) -> Draw:  # noqa: ANN401
    def draw(folder: Path, drawn: Drawn) -> None:
        folder.mkdir()
        given = (save,) if saves else ()
        module = writer(f"formats.phone.test_{name}")
        module.write(folder, drawn.large if large else drawn.world, *given, **options)

    return draw


def _record3d(folder: Path, drawn: Drawn) -> None:
    module = writer("formats.phone.test_record3d")
    folder.mkdir()
    module.unpacked(folder, drawn.world, save)


def _r3d(path: Path, drawn: Drawn) -> None:
    folder = path.with_name("to pack")
    _record3d(folder, drawn)
    writer("formats.phone.test_record3d").packed(path, folder)
    shutil.rmtree(folder)


def _video(folder: Path, drawn: Drawn) -> None:
    folder.mkdir()
    module = writer("formats.capture.test_video_folder")
    module.write(folder, drawn.large, start=0.5, body_from_camera=np.eye(4).tolist())
    write_tum(folder / "odometry.tum", drawn.large.stamps, drawn.large.poses)


def _folder(path: Path, _drawn: Drawn) -> None:
    path.mkdir()
    made = writer("formats.conftest").CaptureFolder(path)
    made.text("gravity.txt", "".join(f"{0.2 * i} 0 1 0\n" for i in range(3)))
    made.text("fixes.txt", "".join(f"{0.2 * i} 8.0 53.0 40.0 5.0\n" for i in range(3)))
    (path / "labels").mkdir()
    for file in (path / "instances").iterdir():
        shutil.copy(file, path / "labels" / file.name)
    made.json("labels.json", {str(i): f"thing {i}" for i in range(6)})


def _tum(folder: Path, drawn: Drawn) -> None:
    writer("formats.dataset.test_tum_rgbd").write(folder, drawn.world, save)


def _transforms(kind: str) -> Draw:
    def draw(folder: Path, drawn: Drawn) -> None:
        folder.mkdir()
        writer("formats.dataset.test_transforms").write(folder, drawn.world, save, kind)

    return draw


def _colmap(form: str, *, own: bool = False) -> Draw:
    def draw(folder: Path, drawn: Drawn) -> None:
        module = writer("formats.dataset.test_colmap")
        model = module.Model(drawn.world)
        getattr(model, form)(folder / "sparse/0")
        module.images(folder, drawn.world, model, save, depth="" if own else "depth/{}.png")
        if own:
            module.own_depth(folder, drawn.world, model)

    return draw


def _rtabmap(**options: Any) -> Draw:  # noqa: ANN401
    def draw(path: Path, drawn: Drawn) -> None:
        writer("formats.dataset.test_rtabmap").write(path, drawn.world, **options)

    return draw


def _sens(colour: int, depth: int) -> Draw:
    def draw(path: Path, _drawn: Drawn) -> None:
        writer("scannet_world").Recording().write_sens(path, colour=colour, depth=depth)

    return draw


def _exported(folder: Path, _drawn: Drawn) -> None:
    writer("scannet_world").Recording().export(folder)


def _sequence(path: Path, _drawn: Drawn) -> None:
    recording = writer("formats.dataset.test_scan3r_sequence").Recording()
    recording.folder(path)


def _sequence_zip(path: Path, drawn: Drawn) -> None:
    _sequence(path / "unzipped", drawn)
    with zipfile.ZipFile(path / "sequence.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted((path / "unzipped/sequence").iterdir()):
            archive.write(file, file.name)
    shutil.rmtree(path / "unzipped")


def _bag(container: str, *, packed: bool = False, layout: Layout | None = None) -> Draw:
    def draw(path: Path, drawn: Drawn) -> None:
        with BagWriter(path, container, packed=packed) as bag:  # type: ignore[arg-type]
            write_capture(bag, drawn.clip, layout or Layout())

    return draw


PACKED = Layout(images="packed", poses="odometry")
CAPTURES: dict[str, dict[str, Draw]] = {
    "capture folder": {"folder": _folder},
    "video with a trajectory": {"video": _video},
    "Stray Scanner": {"stray": _phone("stray", large=True),
                      "all": _phone("stray", large=True, intrinsics=True)},
    "Polycam": {"polycam": _phone("polycam")},
    "Record3D": {"unpacked": _record3d, "walk.r3d": _r3d},
    "MultiScan": {"multiscan": _phone("multiscan", large=True, saves=False)},
    "ios_logger": {"ios": _phone("ios_logger", large=True, saves=False)},
    "3D Scanner App": {"app": _phone("arkit_app")},
    "ARKitScenes": {"scenes": _phone("arkit_scenes")},
    "TUM RGB-D": {"tum": _tum},
    "transforms.json": {k: _transforms(k) for k in ("nerfcapture", "polycam", "spectacular", "record3d")},
    "COLMAP": {"binary": _colmap("binary"), "text": _colmap("text"), "own": _colmap("binary", own=True)},
    "RTAB-Map": {"new.db": _rtabmap(), "old.db": _rtabmap(version="0.11.3", depth="png"),
                 "float.db": _rtabmap(depth="float", optimized=False)},
    "ScanNet .sens": {"png.sens": _sens(1, 1), "raw.sens": _sens(0, 0), "jpeg.sens": _sens(2, 1)},
    "ScanNet export": {"exported": _exported},
    "3RScan sequence": {"folder": _sequence, "zip": _sequence_zip},
    "bags MCAP": {"plain": _bag("mcap"), "packed": _bag("mcap", packed=True),
                  "compressed": _bag("mcap", layout=PACKED)},
    "bags db3": {"rosbag2": _bag("sqlite3"), "compressed": _bag("sqlite3", layout=PACKED)},
    "bags rosbag1": {"walk.bag": _bag("rosbag1"), "packed.bag": _bag("rosbag1", packed=True)},
}  # fmt: skip
"""Of each layout its seeds: a name of a file or folder, and what draws it there."""
