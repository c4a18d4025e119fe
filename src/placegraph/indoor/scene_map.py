"""The scene map: one scene graph of objects with one coarse mesh, in which captures are localized."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from placegraph.errors import OptionError
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.map.scene_file import open_scene, save_scene

if TYPE_CHECKING:
    from collections.abc import Callable
    from os import PathLike
    from pathlib import Path

    from numpy.typing import ArrayLike

    from placegraph.estimate import PoseEstimate
    from placegraph.formats.capture.capture import Capture
    from placegraph.geometry import Camera
    from placegraph.indoor.encode import Encoder, MapEncoder
    from placegraph.indoor.language import Sentence
    from placegraph.indoor.likelihood.visibility import VisibilityTable
    from placegraph.indoor.mapping.change.changes import SceneDiff
    from placegraph.indoor.mapping.change.options import DiffOptions
    from placegraph.indoor.mapping.check import Finding
    from placegraph.indoor.options import FilterOptions
    from placegraph.indoor.pose.tracker import Tracker
    from placegraph.indoor.refine import RefineOptions
    from placegraph.indoor.refine.matching import Matcher
    from placegraph.indoor.render import Rendering


@dataclass(frozen=True, eq=False, repr=False)
class SceneMap(Scene):
    """A scene and what can be done with it.

    Made by `build_scene`, `SceneMap.create` or `merge_scenes`, opened by `open_map`; never changed
    by localizing in it.
    """

    def save(self, path: str | PathLike[str]) -> None:
        """Write the map file (atomically, with checksums); raises as `placegraph.store` does."""
        save_scene(self, path)

    @classmethod
    def open(cls, path: str | PathLike[str]) -> SceneMap:
        """Open a map file; raises `InputError` or `MapError` where it is not a sound scene map."""
        return open_scene(path, cls)

    def visibility(self, options: FilterOptions) -> VisibilityTable:
        """What is visible from where, for cameras at `options.heights`; made once for each."""
        from placegraph.indoor.likelihood.visibility import visibility

        return visibility(self, options)

    def localize(
        self,
        capture: Capture,
        *,
        frames: Any = None,  # noqa: ANN401  # see `localize`
        prior: Any = None,  # noqa: ANN401  # see `localize`
        description: str | Sentence | None = None,
        shares: ArrayLike | None = None,
        encoder: str | Encoder | MapEncoder | None = None,
        options: FilterOptions | None = None,
        refine: bool | RefineOptions = True,
        matcher: str | Matcher = "auto",
        seed: int = 0,
        device: str = "auto",
        progress: Callable[[str, int, int], None] | None = None,
    ) -> PoseEstimate:
        """Where the last frame of a capture, and every other, was taken.

        Parameters, result and errors: `placegraph.indoor.localize.localize`.
        """
        from placegraph.indoor.localize import localize

        return localize(
            self, capture, frames=frames, prior=prior, description=description, shares=shares,
            encoder=encoder, options=options, refine=refine, matcher=matcher, seed=seed,
            device=device, progress=progress,
        )  # fmt: skip

    def refine(
        self,
        capture: Capture,
        map_from_camera: ArrayLike,
        *,
        frames: Any = None,  # noqa: ANN401  # see `localize`
        matcher: str | Matcher = "auto",
        options: RefineOptions | None = None,
        seed: int = 0,
        device: str = "auto",
        progress: Callable[[str, int, int], None] | None = None,
    ) -> PoseEstimate:
        """The pose of the last frame, from where it is roughly known to have been taken.

        Parameters, result and errors: `placegraph.indoor.refine.refine`.
        """
        from placegraph.indoor.refine import refine

        return refine(
            self, capture, map_from_camera, frames=frames, matcher=matcher, options=options,
            seed=seed, device=device, progress=progress,
        )  # fmt: skip

    def render(
        self,
        map_from_camera: ArrayLike,
        camera: Camera,
        *,
        samples: int = 4,
        device: str = "auto",
    ) -> Rendering:
        """The map as a camera at a pose (4, 4) would see it.

        Parameters, result and errors: `placegraph.indoor.render.render`.
        """
        from placegraph.indoor.render import render

        return render(self, map_from_camera, camera, samples=samples, device=device)

    def diff(
        self,
        later: Scene | Capture,
        poses: ArrayLike | PoseEstimate | None = None,
        *,
        options: DiffOptions | None = None,
    ) -> SceneDiff:
        """What changed since this map was made, as a later map or a capture with poses shows it.

        Parameters, result and errors: `placegraph.indoor.mapping.change.diff.diff`, and of a
        capture, whose poses (T, 4, 4) are what `localize` said of it,
        `placegraph.indoor.mapping.change.capture.diff.diff_capture`.
        """
        if isinstance(later, Scene):
            from placegraph.indoor.mapping.change.diff import diff

            return diff(self, later, options=options)
        from placegraph.indoor.mapping.change.capture.diff import diff_capture

        if poses is None:
            raise OptionError("poses: a capture needs them; give what scene.localize said of it.")
        return diff_capture(self, later, poses, options=options)

    def updated(self, diff: SceneDiff, **options: Any) -> SceneMap:  # noqa: ANN401  # of `update`
        """Map that has taken over what changed; options: `placegraph.indoor.mapping.change.update.update`."""
        from placegraph.indoor.mapping.change.update import update

        return update(self, diff, **options)

    def check(self) -> list[Finding]:
        """What is odd about the map, worst first: `placegraph.indoor.mapping.check.check`."""
        from placegraph.indoor.mapping.check import check

        return check(self)

    def export(self, path: str | PathLike[str], *, overwrite: bool = False) -> tuple[Path, ...]:
        """Write the map as .glb, .ply or Spark-DSG's .json: `placegraph.indoor.mapping.export.export`."""
        from placegraph.indoor.mapping.export import export

        return export(self, path, overwrite=overwrite)

    def tracker(self, camera: Camera, *, seed: int = 0, **options: Any) -> Tracker:  # noqa: ANN401
        """Localizer for one frame at a time; see `placegraph.indoor.pose.tracker.Tracker`."""
        from placegraph.indoor.pose.tracker import Tracker

        return Tracker(self, camera, seed=seed, **options)
