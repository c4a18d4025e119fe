"""The 3D viewer (viser): a scene map, a capture and an estimate in the browser."""

from __future__ import annotations

import socket
import threading
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import redirect_stdout
from dataclasses import replace
from functools import partial
from io import StringIO
from time import sleep
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import PoseEstimate
from placegraph.core.geometry import quaternion_from_rotation
from placegraph.errors import MissingExtraError, OptionError
from placegraph.indoor.mapping.export import make_materials, make_path_lines, split_surfaces
from placegraph.io.mesh.gltf_write import Material, Part, Surface, encode_glb
from placegraph.view.draw.painter import colour_levels
from placegraph.view.scene.plan import OPENING, particle_levels
from placegraph.view.scene.room_plan import ROOM_PAINTS, room_paint

if TYPE_CHECKING:
    import viser

    from placegraph.indoor.scene_map import SceneMap

INKS = (
    (230, 74, 25), (30, 136, 229), (67, 160, 71), (142, 36, 170), (255, 179, 0), (0, 137, 123),
    (216, 27, 96), (109, 76, 65),
)  # fmt: skip
"""Colours of kinds of relations, and of camera paths, in turn."""
PICKED = (255, 111, 0)
"""Colour of the box around the selected object."""
_EDGES = np.array([(i, i | bit) for bit in (1, 2, 4) for i in range(8) if not i & bit])
_CORNERS = np.array([(i & 1, i >> 1 & 1, i >> 2) for i in range(8)])


class SceneView:
    """Objects, labels and relations of a map, and the controls that show and hide them."""

    def __init__(self, server: viser.ViserServer, scene: SceneMap) -> None:
        self.server, self.scene = server, scene
        graph = scene.graph
        self.titles = _make_titles(graph.names, graph.labels, graph.ids)
        roles = [ROOM_PAINTS[room_paint(label)].role for label in graph.labels]
        self.shown = [role != "ceiling" for role in roles]
        """Whether each object is to be seen; ceilings would hide what is below."""
        server.scene.set_up_direction("+z")
        self._set_initial_camera()
        self.objects = self._objects()
        self.labels = self._labels(roles)
        self.relations = self._relations()
        self.paths: dict[str, viser.LineSegmentsHandle] = {}
        self.picked: int | None = None
        self.box: viser.LineSegmentsHandle | None = None
        self._controls()
        self._update()

    def add_paths(self, paths: Mapping[str, NDArray[Any]]) -> None:
        """Add ways of cameras (T, 4, 4) map_from_camera by name."""
        with self.server.gui.add_folder("Camera paths"):
            for k, (name, poses) in enumerate(paths.items()):
                self.paths[name] = self.server.scene.add_line_segments(
                    f"/paths/{name}",
                    points=make_path_lines(np.asarray(poses)).astype(np.float32),
                    colors=INKS[k % len(INKS)],
                    thickness=0.015,
                )
                box = self.server.gui.add_checkbox(f"{name} ({len(poses)})", initial_value=True)
                _follow(box, [self.paths[name]])

    def pick(self, row: int | None) -> None:
        """Mark an object and say what is known of it; None: mark none."""
        self.picked = row
        if self.box is not None:
            self.box.remove()
            self.box = None
        self.choice.value = "-" if row is None else self.titles[row]
        self.about.content = "" if row is None else self.describe_object(row)
        self.visible.disabled = row is None
        if row is not None:
            self.visible.value = self.shown[row]
            self.box = self.server.scene.add_line_segments(
                "/picked", points=self._box(row), colors=PICKED, thickness=0.02
            )

    def show(self, rows: Iterable[int], *, only: bool = False) -> None:
        """Show objects; `only`: hide all others."""
        wanted = set(rows)
        self.shown = [i in wanted or (s and not only) for i, s in enumerate(self.shown)]
        self._update()

    def hide(self, rows: Iterable[int]) -> None:
        """Hide objects."""
        wanted = set(rows)
        self.shown = [s and i not in wanted for i, s in enumerate(self.shown)]
        self._update()

    def describe_object(self, row: int) -> str:
        """Describe an object in Markdown."""
        graph = self.scene.graph
        lines = [
            f"**{_escape_markdown(self.titles[row])}**",
            "",
            f"- label: {_escape_markdown(graph.labels[row])}",
        ]
        lines.append(f"- id: {_escape_markdown(graph.ids[row])}")
        if graph.extents is not None:
            size = " x ".join(f"{length:.2f}" for length in graph.extents[row])
            lines.append(f"- size: {size} m")
        place = ", ".join(f"{v:.2f}" for v in graph.positions[row])
        lines.append(f"- middle: {place} m")
        told = self.scene.attributes[row].items()
        lines += [f"- {_escape_markdown(key)}: {_escape_markdown(value)}" for key, value in told]
        for source, relation, target in zip(
            graph.sources.tolist(), graph.relations, graph.targets.tolist(), strict=True
        ):
            if source == row:
                lines.append(
                    f"- {_escape_markdown(relation)} {_escape_markdown(self.titles[target])}"
                )
            elif target == row:
                lines.append(
                    f"- {_escape_markdown(self.titles[source])} is {_escape_markdown(relation)} it"
                )
        return "\n".join(lines)

    def _set_initial_camera(self) -> None:
        """Place the initial camera above the south edge, looking down into the map."""
        low, high = self.scene.bounds
        middle, reach = (low + high) / 2, float(np.linalg.norm((high - low)[:2]))
        camera = self.server.initial_camera
        camera.look_at = tuple(middle.tolist())
        camera.position = tuple((middle + reach * np.array([0.0, -0.6, 0.9])).tolist())
        camera.up = (0.0, 0.0, 1.0)

    def _objects(self) -> list[viser.GlbHandle]:
        made = make_materials(self.scene, webp=True)
        surfaces = split_surfaces(self.scene.mesh, len(self.scene))
        handles = []
        for row, own in enumerate(surfaces):
            handle = self.server.scene.add_glb(f"/objects/{row}", glb_data=_object_glb(own, made))
            handle.on_click(partial(self._clicked, row))
            handles.append(handle)
        return handles

    def _clicked(self, row: int, _event: object) -> None:
        self.pick(row)

    def _labels(self, roles: list[str]) -> dict[int, viser.LabelHandle]:
        """Add names above objects, except floors, walls and ceilings."""
        graph = self.scene.graph
        tops = graph.positions.copy()
        if graph.extents is not None:
            tops[:, 2] += graph.extents[:, 2] / 2
        return {
            row: self.server.scene.add_label(
                f"/labels/{row}",
                graph.names[row] or graph.labels[row],
                position=tops[row],
                anchor="bottom-center",
                font_screen_scale=0.8,
            )
            for row, role in enumerate(roles)
            if role == "thing"
        }

    def _relations(self) -> dict[str, viser.LineSegmentsHandle]:
        """Add lines between related objects, by kind, hidden at first."""
        graph = self.scene.graph
        kinds = np.array(graph.relations, np.str_)
        ends = np.stack([graph.positions[graph.sources], graph.positions[graph.targets]], axis=1)
        return {
            kind: self.server.scene.add_line_segments(
                f"/relations/{k}",
                points=ends[kinds == kind].astype(np.float32),
                colors=INKS[k % len(INKS)],
                thickness=0.012,
                visible=False,
            )
            for k, kind in enumerate(sorted(set(graph.relations)))
        }

    def _box(self, row: int) -> NDArray[np.float32]:
        """Return the edges (12, 2, 3) of an object's box [m]."""
        graph = self.scene.graph
        extent = np.zeros(3) if graph.extents is None else graph.extents[row]
        corners = graph.positions[row] + (_CORNERS - 0.5) * extent
        edges: NDArray[np.float32] = corners[_EDGES].astype(np.float32)
        return edges

    def _controls(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Object"):
            # viser's types forbid to set a value, which it allows
            self.choice: Any = gui.add_dropdown("Pick", ("-", *self.titles), initial_value="-")
            self.visible: Any = gui.add_checkbox("Shown", initial_value=True, disabled=True)
            self.about = gui.add_markdown("")
            alone = gui.add_button("Show it alone")
            everything = gui.add_button("Show all")
        self.choice.on_update(self._chosen)
        self.visible.on_update(self._switched)
        alone.on_click(lambda _: self._isolate())
        everything.on_click(lambda _: self.show(range(len(self.scene))))
        names = gui.add_checkbox("Names", initial_value=True)
        names.on_update(lambda _: self._update())
        self.names = names
        self._kinds()
        counts = Counter(self.scene.graph.relations)
        with gui.add_folder("Relations", expand_by_default=False):
            for kind, handle in self.relations.items():
                box = gui.add_checkbox(f"{kind} ({counts[kind]})", initial_value=False)
                _follow(box, [handle])

    def _kinds(self) -> None:
        """Add a checkbox for each label, which shows or hides its objects."""
        gui, labels = self.server.gui, self.scene.graph.labels
        with gui.add_folder("Labels", expand_by_default=False):
            for label, count in sorted(Counter(labels).items()):
                rows = [row for row, own in enumerate(labels) if own == label]
                box = gui.add_checkbox(
                    f"{label} ({count})", initial_value=any(self.shown[row] for row in rows)
                )
                box.on_update(partial(self._of_label, rows))

    def _of_label(self, rows: list[int], event: Any) -> None:  # noqa: ANN401  # viser's event
        if event.target.value:
            self.show(rows)
        else:
            self.hide(rows)

    def _chosen(self, _event: object) -> None:
        value = self.choice.value
        row = None if value == "-" else self.titles.index(value)
        if row != self.picked:
            self.pick(row)

    def _isolate(self) -> None:
        if self.picked is not None:
            self.show([self.picked], only=True)

    def _switched(self, _event: object) -> None:
        if self.picked is not None and self.visible.value != self.shown[self.picked]:
            (self.show if self.visible.value else self.hide)([self.picked])

    def _update(self) -> None:
        """Show and hide objects according to the controls."""
        for row, handle in enumerate(self.objects):
            if handle.visible != self.shown[row]:
                handle.visible = self.shown[row]
        for row, label in self.labels.items():
            label.visible = self.shown[row] and self.names.value
        if self.picked is not None and self.visible.value != self.shown[self.picked]:
            self.visible.value = self.shown[self.picked]


def _make_titles(names: Iterable[str], labels: Iterable[str], ids: Iterable[str]) -> list[str]:
    """Return the title of each object: its name, with its id where others share it."""
    said = [name or label for name, label in zip(names, labels, strict=True)]
    counts = Counter(said)
    return [
        title if counts[title] == 1 and title != "-" else f"{title} [{id_}]"
        for title, id_ in zip(said, ids, strict=True)
    ]


def _object_glb(surfaces: list[Surface], made: list[Material]) -> bytes:
    """Return the .glb of a single object, in the map's axes."""
    used = sorted({surface.material for surface in surfaces})
    place = {row: i for i, row in enumerate(used)}
    own = [replace(surface, material=place[surface.material]) for surface in surfaces]
    return encode_glb([Part("object", own)], [made[row] for row in used], turned=False)


def _follow(box: viser.GuiCheckboxHandle, handles: list[viser.LineSegmentsHandle]) -> None:
    """Let a checkbox show and hide handles."""

    def update(_event: object) -> None:
        for handle in handles:
            handle.visible = box.value

    box.on_update(update)


def _escape_markdown(text: str) -> str:
    """Escape a text for Markdown."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]<>()#+-!|" else c for c in text)


HOST, PORT = "127.0.0.1", 8080


class Viewer:
    """A running server; whoever opens its address sees the map. Close it, or use it in `with`."""

    def __init__(
        self,
        server: viser.ViserServer,
        scene: SceneMap,
        camera_paths: Mapping[str, NDArray[Any]],
        run: PoseEstimate | None,
    ) -> None:
        self.server = server
        self.map = SceneView(server, scene)
        paths = dict(camera_paths)
        if run is not None and len(run.trajectory):
            paths["run"] = run.trajectory
        if paths:
            self.map.add_paths(paths)
        self.run = None if run is None else RunView(server, run)

    @property
    def address(self) -> str:
        """Address to open in a browser."""
        host = self.server.get_host()
        shown = socket.gethostname() if host in {"0.0.0.0", "::"} else host  # noqa: S104
        return f"http://{shown}:{self.server.get_port()}"

    def close(self) -> None:
        """Stop the server."""
        self.server.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_viewer(
    scene: SceneMap,
    *,
    camera_paths: Mapping[str, NDArray[Any]] | None = None,
    run: PoseEstimate | None = None,
    host: str = HOST,
    port: int = PORT,
) -> Viewer:
    """Serve a map to browsers.

    Raises `MissingExtraError`: viser is not installed; `OptionError`: the host is none of this
    computer's, or the port is out of range.

    `camera_paths`: names and (T, 4, 4) map_from_camera.
    `run`: an estimate with its particles: made with `FilterOptions(record=True)`, or read by
        `placegraph.indoor.pose.record.read_run`.
    `host`: address to listen at: 127.0.0.1 serves this computer alone, 0.0.0.0 all that can reach
        it.
    `port`: port; the next free one where it is taken.
    """
    try:
        import viser
    except ImportError as error:
        raise MissingExtraError(
            "The viewer needs viser; run `pip install 'placegraph[view]'`."
        ) from error
    if not 1 <= port <= 65535:
        raise OptionError(f"port is {port}; it must be 1 to 65535.")
    _check_host(host)
    with redirect_stdout(StringIO()):  # the caller says where to look, once
        server = viser.ViserServer(host=host, port=port, label=scene.source or None, verbose=False)
    return Viewer(server, scene, camera_paths or {}, run)


def _check_host(host: str) -> None:
    """Raise `OptionError` where nothing can listen at `host`."""
    try:
        family, kind, *_, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        raise OptionError(
            f"host is {host!r}, but this computer cannot listen there ({error}); use "
            "127.0.0.1, or 0.0.0.0 for all networks."
        ) from error


LEAST = 0.01
"""Probability of a mode that is shown."""
MOST = 4000
"""Particles shown of one frame."""
TAIL = 0.15
"""Length of the line that says which way a particle looks [m]."""
PAUSE = 0.25
"""Between two steps that are played [s]."""
MODES = ((30, 136, 229), (255, 179, 0), (120, 120, 120))
"""Colours of the first mode, the second, and others."""


class RunView:
    """Particles of an estimate's history, with a slider over its steps."""

    def __init__(self, server: viser.ViserServer, run: PoseEstimate) -> None:
        self.server, self.run = server, run
        self.steps = [
            (k, step) for k, record in enumerate(run.history) for step in range(len(record.steps))
        ]
        """Pass and row of each step."""
        self.modes = self._modes()
        self.cloud: viser.PointCloudHandle | None = None
        self.tails: viser.LineSegmentsHandle | None = None
        self._playing = threading.Lock()
        with server.gui.add_folder("Run"):
            server.gui.add_markdown(f"**{run.status.name}**: {run.reason}")
            self._controls()

    def show(self, number: int) -> None:
        """Show the particles of a step."""
        k, step = self.steps[number]
        record = self.run.history[k]
        frame, poses, weights = record.steps[step]
        self.said.content = (
            f"pass {k + 1} of {len(self.run.history)}, stride {record.stride:g}, frame {frame}: "
            f"{len(poses):,} particles"
        )
        rows = np.linspace(0, len(poses) - 1, min(len(poses), MOST)).round().astype(np.int64)
        colours = colour_levels(particle_levels(poses, weights))[rows, :3].astype(np.uint8)
        with self.server.atomic():
            self._draw(poses[rows], colours)

    def play(self) -> None:
        """Play all steps once; a second call meanwhile does nothing."""
        if not self._playing.acquire(blocking=False):
            return
        try:
            for number in range(len(self.steps)):
                self.slider.value = number
                sleep(PAUSE)
        finally:
            self._playing.release()

    def _controls(self) -> None:
        gui = self.server.gui
        self.said = gui.add_markdown("No particles were recorded.")
        if not self.steps:
            return
        last = len(self.steps) - 1
        # viser's types forbid to set a value, which it allows
        self.slider: Any = gui.add_slider("Step", 0, max(last, 1), 1, 0, disabled=last == 0)
        self.slider.on_update(lambda _: self.show(min(int(self.slider.value), last)))
        gui.add_button("Play").on_click(lambda _: self.play())
        self.show(0)

    def _draw(self, poses: NDArray[np.float64], colours: NDArray[np.uint8]) -> None:
        heading = np.stack([np.cos(poses[:, 3]), np.sin(poses[:, 3]), np.zeros(len(poses))], axis=1)
        ends = np.stack([poses[:, :3], poses[:, :3] + TAIL * heading], axis=1)
        both = np.repeat(colours[:, None], 2, axis=1)
        for handle in (self.cloud, self.tails):
            if handle is not None:
                handle.remove()
        self.cloud = self.server.scene.add_point_cloud(
            "/run/particles",
            points=poses[:, :3].astype(np.float32),
            colors=colours,
            point_size=0.04,
            point_shape="circle",
            precision="float32",
        )
        self.tails = self.server.scene.add_line_segments(
            "/run/headings", points=ends.astype(np.float32), colors=both, thickness=0.008
        )

    def _modes(self) -> list[viser.CameraFrustumHandle]:
        """Add a camera for each likely mode."""
        handles = []
        for k, mode in enumerate(self.run.modes):
            if k and mode.probability < LEAST:
                continue
            x, y, z, w = quaternion_from_rotation(mode.map_from_camera[:3, :3]).tolist()
            handles.append(
                self.server.scene.add_camera_frustum(
                    f"/run/modes/{k + 1}",
                    fov=OPENING * 0.75,
                    aspect=4 / 3,
                    scale=0.25,
                    color=MODES[min(k, 2)],
                    wxyz=(w, x, y, z),
                    position=mode.map_from_camera[:3, 3],
                )
            )
        return handles
