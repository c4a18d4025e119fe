"""NVIDIA Warp on its CPU device: the same scores as compiled Python."""

import numpy as np
import pytest

from placegraph.indoor.likelihood.model import model_of
from placegraph.indoor.likelihood.score_kernels import score_poses
from placegraph.indoor.likelihood.view import View
from placegraph.indoor.likelihood.warp import WarpScorer
from placegraph.indoor.options import Likelihood
from placegraph.indoor.rays.warp import WarpCaster

pytest.importorskip("warp", reason="needs NVIDIA Warp, the extra gpu")


def _view(scene, pose, rng, terms):
    """What a camera might see at a pose: true depth and colours with noise, patches of chance."""
    rows, columns, objects = 24, 32, len(scene.graph)
    y, x = np.mgrid[:rows, :columns]
    y, x = (a.reshape(rows // 4, 4, columns // 4, 4).swapaxes(1, 2).ravel() for a in (y, x))
    along = np.stack([np.ones(x.size), (15.5 - x) / 24, (11.5 - y) / 24], axis=1)
    c, s = np.cos(pose[3]), np.sin(pose[3])
    turned = along @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    hits = scene.caster.cast(pose[:3], turned)
    hit = hits.triangle >= 0
    depth = np.where(hit & (rng.random(x.size) < 0.9), hits.distance, 0.0)
    patch = (y // 3 * 8 + x // 4).astype(np.int32)
    patch[rng.random(x.size) < 0.05] = -1
    semantic = rng.uniform(0.3, 1.7, (8 * 8 + 1, objects + 1))
    semantic[patch[hit], scene.mesh.object_of[hits.triangle[hit]]] += 8.0
    light = np.abs(np.sin(7 * np.where(hit, hits.distance, 0.0)))
    weight = rng.choice([0.0, 0.4, 1.0], 65)
    return View(
        directions=along.astype(np.float32),
        patch=patch,
        semantic=semantic.astype(np.float32),
        weight=weight.astype(np.float32),
        depth=(depth * rng.normal(1.0, 0.02, x.size)).astype(np.float32),
        usual_depth=rng.uniform(-1, 1, x.size).astype(np.float32),
        colour=(light[:, None] * [1.0, 0.1, -0.1] + rng.normal(0, 0.02, (x.size, 3))).astype("f4"),
        footprint=1 / 24,
        terms=np.array(terms),
    )


@pytest.mark.parametrize("kind", ["calibrated", "gaussian"])
def test_scores_agree(room, kind, rng):
    """Scores to 1e-4 of theirs, where every ray hits the same triangle: nearly everywhere."""
    low, high = room.bounds
    poses = np.column_stack([rng.uniform(low, high, (200, 3)), rng.uniform(-3, 3, 200)])
    poses[:100] = poses[0] + rng.normal(size=(100, 4)) * 0.05
    scorer = WarpScorer(room, "cpu")
    model = model_of(Likelihood(kind=kind)).noise
    for terms in ([True, True, True], [True, False, False], [False, True, False]):
        asked = [*terms, all(terms) and kind == "calibrated"]  # tones count beside depth
        view = _view(room, poses[0], rng, terms)
        alike = _alike(room, poses, view)
        assert alike.mean() > 0.9
        expected = score_poses(room.caster.tracer, room.surface, poses, view, model)
        for _ in range(2):  # the second time the view is there already
            scores = scorer.score(poses, view, model)
            error = np.abs(scores - expected) / np.maximum(np.abs(expected), 1.0)
            # a ray may still go another way, rounded otherwise; grazing rays differ in depth
            assert np.quantile(error[alike], 0.97, axis=0)[:2].max() <= 1e-4
            assert error[alike, :2].max() <= 1e-2
            assert np.quantile(error[alike, 2:], 0.97, axis=0).max() <= 1e-4
        assert ((np.ptp(expected, axis=0) > 0.1) == asked).all()  # there was something to see


def _alike(scene, poses, view):
    """Poses (N,) all of whose rays hit the same triangles by either caster."""
    c, s = np.cos(poses[:, 3]), np.sin(poses[:, 3])
    o = np.zeros(len(c))
    turn = np.stack([c, -s, o, s, c, o, o, o, o + 1], axis=1).reshape(-1, 3, 3)
    rays = np.einsum("nij,rj->nri", turn, view.directions).reshape(-1, 3)
    origins = np.repeat(poses[:, :3], len(view.directions), axis=0)
    warp = WarpCaster(scene.mesh.vertices, scene.mesh.triangles, device="cpu")
    same = warp.cast(origins, rays).triangle == scene.caster.cast(origins, rays).triangle
    return same.reshape(len(poses), -1)[:, view.patch >= 0].all(axis=1)


def test_more_poses_than_fit_at_once(room, rng, monkeypatch):
    poses = np.column_stack([rng.uniform(*room.bounds, (50, 3)), rng.uniform(-3, 3, 50)])
    view, model = _view(room, poses[0], rng, [True, True, True]), model_of(Likelihood()).noise
    scorer = WarpScorer(room, "cpu")
    whole = scorer.score(poses, view, model)
    monkeypatch.setattr("placegraph.indoor.likelihood.warp.BATCH", 7 * len(view.directions))
    np.testing.assert_array_equal(scorer.score(poses, view, model), whole)
    assert scorer.score(poses[:0], view, model).shape == (0, 4)
