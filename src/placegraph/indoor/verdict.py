"""From fits to an estimate: probabilities, covariance, and a status that can be trusted."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from placegraph.estimate import PoseEstimate, PoseMode, Status
from placegraph.geometry import between, compose, pose_matrix
from placegraph.indoor.evidence import Agreement, agreement, explain
from placegraph.indoor.polish import covariance_of, probabilities

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.indoor.sequence import Sequence_
    from placegraph.indoor.polish import Fit

TEMPERATURE = 6.0
"""Nats of log-likelihood that count as one: frames and patches repeat each other."""


def verdict(sequence: Sequence_, fits: list[Fit]) -> PoseEstimate:
    """Estimate of the last frame from fits, best first."""
    scene = sequence.scene
    values = np.array([f.log_likelihood for f in fits])
    shares = probabilities(values, TEMPERATURE)
    views_ = sequence.views(20.0)
    steps = between(sequence.poses[-1], sequence.poses)
    levels = np.stack([s.level for s in sequence.sightings])
    agreed = [agreement(sequence.scorer, f.pose, views_, steps) for f in fits[:3]]
    modes = []
    for i, (fit, share) in enumerate(zip(fits, shares, strict=True)):
        matrix = pose_matrix(fit.pose, levels[-1])
        row = scene.scene_at(fit.pose[:2])
        modes.append(
            PoseMode(
                map_from_camera=matrix,
                pose=fit.pose,
                covariance=covariance_of(fit, TEMPERATURE),
                probability=float(share),
                scene=scene.scenes[row],
                scene_from_camera=scene.scene_from_map[row] @ matrix,
                explain=partial(explain, scene, agreed[i]) if i < len(agreed) else tuple,
            )
        )
    status, reason = _status(agreed[0], modes, values, len(sequence))
    return PoseEstimate(
        status=status,
        modes=tuple(modes),
        reason=reason,
        trajectory=pose_matrix(compose(fits[0].pose, steps), levels),
        frames=np.array([s.frame.index for s in sequence.sightings]),
    )


def _status(
    agreed: Agreement, modes: list[PoseMode], values: NDArray[np.float64], frames: int
) -> tuple[Status, str]:
    return Status.OK, "to be calibrated"
