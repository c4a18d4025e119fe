"""The scene map: one scene graph of objects with one coarse mesh, in which captures are localized."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from placegraph.core.pickling import HtmlRepr
from placegraph.errors import OptionError
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.map.scene_file import open_scene, save_scene

if TYPE_CHECKING:
    import geopandas as gpd

    from placegraph.core.estimate import PoseEstimate
    from placegraph.core.geometry import Camera
    from placegraph.indoor.encode import Encoder, MapEncoder
    from placegraph.indoor.language import Sentence
    from placegraph.indoor.likelihood.visibility import VisibilityTable
    from placegraph.indoor.mapping.change.changes import DiffOptions, SceneDiff
    from placegraph.indoor.mapping.check import Finding
    from placegraph.indoor.options import PoseSearchOptions
    from placegraph.indoor.pose.prior import Prior
    from placegraph.indoor.pose.window import Progress
    from placegraph.indoor.refine import RefineOptions
    from placegraph.indoor.refine.matching import Matcher
    from placegraph.indoor.render import Rendering
    from placegraph.indoor.track.live import LiveTracker
    from placegraph.indoor.track.tracker import Tracker
    from placegraph.io.capture.capture import Capture
    from placegraph.io.capture.frame import Frame


@dataclass(frozen=True, eq=False, repr=False)
class SceneMap(HtmlRepr, Scene):
    """Scene map, in which captures are localized.

    Made by `build_scene`, `SceneMap.create` or `merge_scenes`, opened by `open_map`; localization never
    changes it.
    """

    def save(self, path: str | PathLike[str]) -> None:
        """Write the map file (atomically, with checksums); raises as `placegraph.core.mapfile` does."""
        save_scene(self, path)

    @classmethod
    def open(cls, path: str | PathLike[str]) -> SceneMap:
        """Open a map file; raises `InputError` or `MapError` where it is not a sound scene map."""
        return open_scene(path, cls)

    def visibility(self, options: PoseSearchOptions) -> VisibilityTable:
        """Return the visibility table for cameras at `options.heights`; built once for each."""
        from placegraph.indoor.likelihood.visibility import visibility

        return visibility(self, options)

    def localize(
        self,
        capture: Capture | Sequence[Frame],
        *,
        frames: slice | Sequence[int] | None = None,
        prior: Prior | None = None,
        description: str | Sentence | None = None,
        shares: ArrayLike | None = None,
        encoder: str | Encoder | MapEncoder | None = None,
        options: PoseSearchOptions | None = None,
        refine: bool | RefineOptions = True,
        matcher: str | Matcher = "auto",
        seed: int = 0,
        device: str = "auto",
        progress: Progress | None = None,
    ) -> PoseEstimate:
        """Localize a capture: pose of the last frame, and of every other.

        The same seed on the same machine gives the same answer; the map is only read.

        Parameters
        ----------
        capture, frames
            A capture, or frames in order of time; which of them, all if not given.
        prior
            Location prior of the first frame; else the whole map is searched.
        description
            Description of where the last frame was taken, "next to the sofa" (of a capture longer than
            `localize.WINDOW`, which is tracked, the first frame). It guides the search, and is evidence
            for the poses found.
        shares
            (S,) of a merged map: share of the search that each of its scenes gets.
        encoder
            Encoder of patches: a name such as ``appearance``, an `Encoder`, or one bound to this map;
            the capture's own labels if not given.
        options
            `PoseSearchOptions` or `FilterOptions`; the best of the benchmark if not given.
        refine
            Fit the best mode to images and depth, to centimetres; `RefineOptions` say how.
        matcher
            How images are matched with renderings: ``guided`` needs no extra; ``sift``, ``xfeat``,
            ``roma``, ``romav2`` need theirs; ``auto`` is the guided one, but for several
            `RefineOptions.views` RoMa, or SIFT without it; or your own `Matcher`.
        seed, device, progress
            Seed of all randomness; ``auto`` or ``cpu``, or ``cuda`` for a matcher that is a network;
            called with what is done, how far, and of how much.

        Raises
        ------
        OptionError
            No frame is chosen, or nothing in the frames or the description can be compared with the map.
        MapError, InputError
            The map holds vectors of another encoder; an image is broken.
        MissingExtraError
            The matcher asked for needs an extra.

        """
        from placegraph.indoor.localize import localize_capture

        return localize_capture(
            self, capture, frames=frames, prior=prior, description=description, shares=shares,
            encoder=encoder, options=options, refine=refine, matcher=matcher, seed=seed,
            device=device, progress=progress,
        )  # fmt: skip

    def refine(
        self,
        capture: Capture | Sequence[Frame],
        map_from_camera: ArrayLike,
        *,
        frames: slice | Sequence[int] | None = None,
        matcher: str | Matcher = "auto",
        options: RefineOptions | None = None,
        seed: int = 0,
        device: str = "auto",
        progress: Progress | None = None,
    ) -> PoseEstimate:
        """Refine a rough pose of the last frame, such as from a marker, Wi-Fi, or the last session.

        With depth, the neighbourhood is searched first, as wide as `RefineOptions.reach`.

        Parameters
        ----------
        capture, frames, matcher, seed, device, progress
            See `localize`. Of more than 30 frames the newest 30 are used.
        map_from_camera
            (4, 4) of the last frame chosen, to about 0.3 m and 15 degrees.
        options
            `RefineOptions`; the best of the benchmark if not given.

        Returns
        -------
        PoseEstimate
            `OK` at the refined pose, or `AMBIGUOUS` at the pose that was given, with the reason in
            `refinement`.

        Raises
        ------
        OptionError
            The pose is not rigid, no frame is chosen, or an option is out of its range.
        InputError
            An image is broken, or a matcher's weights are.
        MissingExtraError
            The matcher asked for needs an extra.

        """
        from placegraph.indoor.options import PoseSearchOptions, check_device
        from placegraph.indoor.pose.estimate import add_earth_poses
        from placegraph.indoor.pose.window import PoseQuery
        from placegraph.indoor.refine import RefineSetup, refine
        from placegraph.indoor.render import check_pose

        refining = RefineSetup.of(options, matcher, device)
        check_device(device, network=refining.matcher is not None)
        senses = PoseSearchOptions(
            depth=refining.options.depth, colour=bool(refining.options.images)
        )
        query = PoseQuery.of(
            self, capture, frames=frames, options=senses, seed=seed, progress=progress,
        )  # fmt: skip
        return add_earth_poses(self, refine(query, check_pose(map_from_camera), refining))

    def render(
        self, map_from_camera: ArrayLike, camera: Camera, *, samples: int = 4, device: str = "auto"
    ) -> Rendering:
        """Render the map as a camera at a pose (4, 4) sees it.

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
        """Find changes since this map was made, by a later map or a capture with poses.

        Parameters, result and errors: `placegraph.indoor.mapping.change.diff.diff`, and of a
        capture, with poses (T, 4, 4) or an estimate of `localize`,
        `placegraph.indoor.mapping.change.diff_capture.diff_capture`.
        """
        if isinstance(later, Scene):
            from placegraph.indoor.mapping.change.diff import diff

            return diff(self, later, options=options)
        from placegraph.indoor.mapping.change.diff_capture import diff_capture

        if poses is None:
            raise OptionError(
                "poses: they are missing, but a capture needs them; give the estimate of "
                "scene.localize."
            )
        return diff_capture(self, later, poses, options=options)

    def updated(self, diff: SceneDiff, **options: Any) -> SceneMap:  # noqa: ANN401  # of `update`
        """Apply changes to the map; options: `placegraph.indoor.mapping.change.update.update`."""
        from placegraph.indoor.mapping.change.update import update

        return update(self, diff, **options)

    def check(self) -> list[Finding]:
        """Check the map for oddities, worst first: `placegraph.indoor.mapping.check.check`."""
        from placegraph.indoor.mapping.check import check

        return check(self)

    def export(self, path: str | PathLike[str], *, overwrite: bool = False) -> tuple[Path, ...]:
        """Write the map as .glb, .ply or Spark-DSG's .json: `placegraph.indoor.mapping.export.export`."""
        from placegraph.indoor.mapping.export import export

        return export(self, path, overwrite=overwrite)

    def to_geojson(self) -> dict[str, Any]:
        """Return the footprints of the objects as a GeoJSON FeatureCollection, by the best anchor.

        Properties: `id`, `label`, `name`, `room`, `scene`, `level`, `building`, `height` of its
        lower end above the ellipsoid and how `tall` it is [m]. Raises `GeoPoseError` where the map
        is not anchored.
        """
        from placegraph.indoor.map.scene import make_geojson

        return make_geojson(self)

    def to_geopandas(self) -> gpd.GeoDataFrame:
        """Return `to_geojson` as a table in WGS84; raises `MissingExtraError` without GeoPandas."""
        from placegraph.core.geojson import to_geopandas

        return to_geopandas(self.to_geojson())

    def tracker(self, camera: Camera, *, seed: int = 0, **known: Any) -> Tracker:  # noqa: ANN401
        """Make a tracker of one frame at a time (`track.tracker.Tracker`), for frames of a camera.

        `known`: options, encoder, description, shares and device, see `localize`.
        """
        from placegraph.indoor.pose.window import PoseQuery
        from placegraph.indoor.track.tracker import Tracker

        return Tracker(PoseQuery.of(self, seed=seed, **known), camera)

    def live(self, camera: Camera | None = None, **options: Any) -> LiveTracker:  # noqa: ANN401
        """Make a live tracker: the pose at any time, by asynchronous odometry and images.

        Options and errors: `placegraph.indoor.track.live.LiveTracker`.
        """
        from placegraph.indoor.track.live import LiveTracker

        return LiveTracker(self, camera, **options)
