"""What `placegraph scene localize` and `scene refine` answer: words, pictures and files."""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees, hypot, sqrt
from typing import TYPE_CHECKING

import click

from placegraph.cli.common import console, table

if TYPE_CHECKING:
    from pathlib import Path

    from placegraph.core.estimate import PoseEstimate, PoseMode, Refinement
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.io.capture.capture import Capture

MOST_OBJECTS = 6
"""Objects of the evidence that are printed."""
LEAST = 0.001
"""Probability of a mode that is printed; JSON has all."""


@dataclass(frozen=True)
class Files:
    """Pictures and texts that are asked for."""

    title: str
    png: Path | None = None
    gif: Path | None = None
    tum: Path | None = None
    overlay: Path | None = None
    record: Path | None = None

    def write(
        self, scene: SceneMap, estimate: PoseEstimate, chosen: Capture, *, device: str
    ) -> None:
        """Write them; of an estimate without a pose there is no overlay, which is said on stderr."""
        if self.tum is not None:
            write_tum_of(estimate, chosen, self.tum)
        if self.record is not None:
            from placegraph.indoor.pose.record import write_run

            write_run(self.record, estimate, source=scene.source)
        if self.png is not None:
            from placegraph.view import write_plan

            write_plan(scene, estimate, self.png, title=self.title, camera=chosen.camera)
        if self.gif is not None:
            from placegraph.view import write_plan_animation

            write_plan_animation(scene, estimate, self.gif, title=self.title, camera=chosen.camera)
        if self.overlay is not None and estimate.best is not None:
            from placegraph.view import write_overlay

            write_overlay(scene, estimate, chosen, self.overlay, device=device)
        elif self.overlay is not None:
            click.echo(f"{self.overlay} is not written: there is no pose to show.", err=True)


def write_tum_of(estimate: PoseEstimate, capture: Capture, path: Path) -> None:
    """Write the pose of every frame, and how it came about."""
    from placegraph.io.capture.tum import write_tum

    stamp_of = {frame.index: frame.stamp for frame in capture}
    stamps = [stamp_of[row] for row in estimate.frames.tolist()]
    said = f"map_from_camera, {estimate.status.name}: {estimate.reason}"
    if estimate.refinement is not None and estimate.refinement.reason != estimate.reason:
        said = f"{said} {estimate.refinement.reason}"
    write_tum(path, stamps, estimate.trajectory, comment=said)


def show(estimate: PoseEstimate, *, before: str = "coarse pose") -> None:
    """Print an estimate so that a person can read it; `before`: what was refined."""
    out = console()
    out.print(f"{estimate.status.name}: {estimate.reason}")
    for rank, mode in enumerate(estimate.modes, 1):
        if rank == 1 or mode.probability >= LEAST:
            out.print(f"{rank}. {pose_words(mode)}")
    if estimate.refinement is not None:
        out.print(refinement_words(estimate.refinement, before))
    of_objects = [e for e in estimate.evidence if e.objects]
    of_senses = [e for e in estimate.evidence if not e.objects]
    if estimate.evidence:
        rows = table("", "evidence", "nat", "")
        for e in [*of_objects[:MOST_OBJECTS], *of_senses]:
            sign = {"for": "+", "against": "-"}.get(e.verdict, " ")
            rows.add_row(sign, e.statement, f"{e.weight:+.1f}" if e.objects else "", e.note)
        out.print(rows)
    if len(of_objects) > MOST_OBJECTS:
        out.print(f"and {len(of_objects) - MOST_OBJECTS} more objects (--json names them)")


def pose_words(mode: PoseMode) -> str:
    """A mode in numbers: x, y, z [m], yaw [deg], probability, standard deviations."""
    x, y, z, yaw = mode.pose.tolist()
    sx, sy, *_, turn = (sqrt(max(v, 0.0)) for v in mode.covariance.diagonal().tolist())
    scene = f"  in {mode.scene}" if mode.scene else ""
    return (
        f"x {x:.3f} m  y {y:.3f} m  z {z:.3f} m  yaw_deg {degrees(yaw):.2f}  "
        f"{mode.probability:6.1%}  ±{100 * hypot(sx, sy):.1f} cm ±{degrees(turn):.2f}°{scene}"
    )


def refinement_words(refinement: Refinement, before: str = "coarse pose") -> str:
    """What became of a refinement, in a line: accepted or not, why, and how far the pose moved."""
    shift, turn = (refinement.stats.get(key, 0.0) for key in ("shift_m", "turn_deg"))
    way = f"{100 * shift:.1f} cm and {turn:.2f}°"
    if refinement.accepted:
        return f"{refinement.reason} The pose moved by {way}."
    away = f"; the one refused lies {way} from it" if shift > 0.002 or turn > 0.1 else ""
    return f"{refinement.reason} The {before} stands{away}."
