"""Scores of poses against the same equations written slowly, ray by ray, in plain numpy."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.indoor.conftest import view_frames
from tests.indoor.likelihood.conftest import draw_view

from placegraph.core.geometry import compose, rotation_z
from placegraph.indoor.encode.labels import InstancesEncoder
from placegraph.indoor.likelihood.observe import View
from placegraph.indoor.likelihood.score import Scorer, model_of
from placegraph.indoor.likelihood.score_kernels import (
    COLOUR,
    DEPTH,
    FLAT,
    SEMANTIC,
    STEEPEST,
    TONE,
    score_poses,
    show_view,
)
from placegraph.indoor.map.map_kernels import opponent_colour, sample_colour
from placegraph.indoor.map.mesh import Mesh, Surface
from placegraph.indoor.options import Likelihood, PoseSearchOptions
from placegraph.indoor.rays import RayCaster
from placegraph.indoor.rays.embree import explain_unavailable

CALIBRATED = model_of(Likelihood()).noise
PAPER = model_of(Likelihood(kind="gaussian")).noise
MODELS = pytest.mark.parametrize("model", [CALIBRATED, PAPER], ids=["calibrated", "paper"])


@pytest.fixture(params=["embree", "bvh"])
def backend(request):
    if request.param == "embree" and (reason := explain_unavailable()):
        pytest.skip(reason)
    return request.param


def cast(caster, pose, view):
    """Hits of a view's rays from one pose (4,)."""
    return caster.cast(np.array(pose[:3]), view.directions @ rotation_z(pose[3]).T)


def slow_scores(caster, surface, pose, view, model):
    """Semantic, depth, colour and tone of one pose: the equations of `score`, `options.Likelihood`."""
    hits = cast(caster, pose, view)
    used = view.patch >= 0
    return (
        slow_semantic(hits, surface, view, used, model) if view.terms[SEMANTIC] else 0.0,
        slow_depth(hits, view, used, model) if view.terms[DEPTH] else 0.0,
        slow_colour(hits, surface, view, used, model) if view.terms[COLOUR] else 0.0,
        slow_tone(hits, surface, view, used, model) if all(view.terms[1:]) else 0.0,
    )


def slow_semantic(hits, surface, view, used, model):
    """Per patch: the mean ratio over its rays, whatever objects they hit; misses are column N.

    Sec. 3.3: of the object that most rays hit, summed and divided by all patches of the grid.
    """
    nothing = view.semantic.shape[1] - 1
    terms = []
    for patch, weight in enumerate(view.weight):
        rows = np.flatnonzero(used & (view.patch == patch))
        if not rows.size or weight == 0:
            continue
        seen = [surface.object_of[t] if t >= 0 else nothing for t in hits.triangle[rows]]
        if model.gaussian:
            if patch < len(view.weight) - 1:
                terms.append(view.semantic[patch, np.bincount(seen).argmax()])
            continue
        terms.append(weight * math.log(float(np.mean(view.semantic[patch, seen]))))
    return float(sum(terms)) / ((len(view.weight) - 1) if model.gaussian else 1)


def slow_depth(hits, view, used, model):
    rows = np.flatnonzero(used & (view.depth > 0))
    expected, measured = hits.distance[rows].astype(float), view.depth[rows].astype(float)
    if model.gaussian:
        if not rows.size:
            return 0.0
        return 2 * (1 - float(np.minimum(np.abs(expected - measured) / model.depth_clip, 1).mean()))
    total = 0.0
    for e, m, usual in zip(expected, measured, view.background_depth[rows], strict=True):
        if not math.isfinite(e):
            continue  # where the map ends nothing is known
        off = (e - m) / (model.depth_floor + model.depth_slope * m)
        good = 1 / (1 + off * off)
        cost = model.near_cost if e > m else model.far_cost
        total += good * model.depth_gain - (1 - good) * cost - usual
    return model.depth_weight * total / used.sum()


def colours_shown(hits, surface, view, used):
    """(R, 3) what the map shows at samples; NaN: nothing."""
    shown = np.full((len(used), 3), np.nan)
    for r in np.flatnonzero(used & (hits.triangle >= 0)):
        footprint = np.float32(hits.distance[r] * view.footprint)
        shown[r] = opponent_colour(
            *sample_colour(surface, hits.triangle[r], hits.u[r], hits.v[r], footprint)
        )
    return shown


def slow_tone(hits, surface, view, used, model):
    """Mean over channels of what the correlation of colours tells, times the share that hits."""
    shown = colours_shown(hits, surface, view, used)
    there = ~np.isnan(shown[:, 0])
    if model.gaussian or there.sum() < 16:
        return 0.0
    total = 0.0
    for q, r in zip(view.colour[there].T.astype(float), shown[there].T, strict=True):
        if q.var() > 1e-4 and r.var() > 1e-4:
            total -= math.log(1 - np.clip(np.corrcoef(q, r)[0, 1], 0, 0.99) ** 2) / 6
    return model.tone_weight * there.sum() / used.sum() * total


def slow_colour(hits, surface, view, used, model):
    shown = colours_shown(hits, surface, view, used)
    seen = view.colour.astype(float)
    there = ~np.isnan(shown[:, 0])
    if model.gaussian:  # SSIM of the lightness of each tile of 4 x 4
        total = 0.0
        for tile in range(len(used) // 16):
            rows = 16 * tile + np.flatnonzero(there[16 * tile : 16 * tile + 16])
            if rows.size > 1:
                total += rows.size * ssim(seen[rows, 0], shown[rows, 0])
        return max(0.0, 2 * total / used.sum())
    lane = np.arange(len(used)) % 16
    here = np.concatenate([np.flatnonzero(lane % 4 < 3), np.flatnonzero(lane < 12)])
    beyond = np.concatenate([np.flatnonzero(lane % 4 < 3) + 1, np.flatnonzero(lane < 12) + 4])
    inside = used[here] & used[beyond]
    both = inside & there[here] & there[beyond]
    if both.sum() < 16:
        return 0.0
    q, r = (
        np.clip((x[beyond[both]] - x[here[both]]) / STEEPEST, -1, 1).ravel() for x in (seen, shown)
    )
    flat = FLAT * q.size
    rho = (q * r).sum() / math.sqrt(((q * q).sum() + flat) * ((r * r).sum() + flat))
    rho = min(max(rho, 0.0), 0.99)
    return -model.colour_weight * both.sum() / inside.sum() * 0.5 * math.log(1 - rho * rho)


def ssim(a, b):
    """Wang et al. 2004, for lightness from 0 to 3."""
    c1, c2 = (0.01 * 3) ** 2, (0.03 * 3) ** 2
    covariance = ((a - a.mean()) * (b - b.mean())).mean()
    above = (2 * a.mean() * b.mean() + c1) * (2 * covariance + c2)
    return above / ((a.mean() ** 2 + b.mean() ** 2 + c1) * (a.var() + b.var() + c2))


def poses_in(bounds, rng, count):
    low, high = bounds
    return np.column_stack([rng.uniform(low, high, (count, 3)), rng.uniform(-4, 4, count)])


def camera_view(rng, objects, model, **options):
    return draw_view(rng, objects, gaussian=model.gaussian, **options)


def seen_by_itself(caster, surface, pose, view):
    """The view that a perfect camera at this pose has of the map."""
    hits = cast(caster, pose, view)
    hit = hits.triangle >= 0
    colour = np.nan_to_num(colours_shown(hits, surface, view, hit)).astype(np.float32)
    return view._replace(depth=np.where(hit, hits.distance, 0).astype(np.float32), colour=colour)


def compared(caster, surface, poses, view, model):
    """Scores, fast and slow, of those poses all of whose rays hit the same triangles in both.

    Rays along an edge, or at two surfaces in one place, go either way in four bytes.
    """
    got = score_poses(caster.tracer, surface, poses, view, model)
    used = view.patch >= 0
    alike = [
        (show_view(caster.tracer, surface, p, view, model)[1] == cast(caster, p, view).triangle)[
            used
        ].all()
        for p in poses
    ]
    assert np.mean(alike) > 0.5
    expected = [slow_scores(caster, surface, p, view, model) for p in poses[alike]]
    return got[alike], np.array(expected)


def agree(got, expected, share=1.0):
    """To 2e-3, which is the moments of colours in four bytes; `share` of them, the rest to 0.1."""
    error = np.abs(got - expected) / np.maximum(1.0, np.abs(expected))
    assert np.quantile(error, share) < 2e-3
    assert error[:, :2].max() < (1e-4 if share == 1.0 else 0.1)


@MODELS
def test_scores_of_chance(model, room, backend, rng):
    caster = RayCaster(room.mesh.vertices, room.mesh.triangles, backend=backend)
    view = camera_view(rng, len(room), model)
    poses = poses_in(room.bounds + np.array([[-0.3], [0.3]]), rng, 60)
    got, expected = compared(caster, room.surface, poses, view, model)
    agree(got, expected)
    assert (np.ptp(got, axis=0) > 0.1)[: TONE if model.gaussian else None].all()


@MODELS
@pytest.mark.parametrize("kind", ["instances", "labels"])
def test_scores_of_frames_near_the_truth(model, kind, room, walk, truth, rng):
    likelihood = Likelihood(kind="gaussian" if model.gaussian else "calibrated")
    options = PoseSearchOptions(likelihood=likelihood)
    encoder = InstancesEncoder(room) if kind == "instances" else None
    (view,) = view_frames(room, walk[4:5], options, encoder)
    at = truth(walk)[4]
    yaw = math.atan2(at[1, 2], at[0, 2])
    poses = np.array([*at[:3, 3], yaw]) + rng.normal(size=(40, 4)) * (0.1, 0.1, 0.05, 0.05)
    got, expected = compared(room.caster, room.surface, poses, view, model)
    agree(got, expected)
    assert view.terms.tolist() == [encoder is not None, True, True]
    far = poses_in(room.bounds, rng, 40)
    elsewhere = score_poses(room.caster.tracer, room.surface, far, view, model)
    wanted = view.terms
    assert (np.median(got, axis=0) > np.median(elsewhere, axis=0))[:TONE][wanted].all()
    assert model.gaussian or np.median(got[:, TONE]) > np.median(elsewhere[:, TONE])


@MODELS
def test_maps_with_holes(model, room, rng):
    mesh = room.mesh
    kept = rng.random(len(mesh)) < 0.5
    holed = replace(
        mesh, triangles=mesh.triangles[kept], object_of=mesh.object_of[kept],
        texture_of=mesh.texture_of[kept],
    )  # fmt: skip
    caster, surface = RayCaster(holed.vertices, holed.triangles), Surface.of(holed)
    view = camera_view(rng, len(room), model)
    poses = poses_in(room.bounds, rng, 60)
    missed = [(cast(caster, p, view).triangle < 0).mean() for p in poses]
    assert 0.1 < np.mean(missed) < 0.95
    got, expected = compared(caster, surface, poses, view, model)
    agree(got, expected, share=0.98)  # whether a ray grazes a rim hangs on the processor


@MODELS
@pytest.mark.parametrize(
    "terms", [(True, False, False), (False, True, False), (False, False, True), (False, True, True)]
)
def test_only_the_terms_asked_for(model, terms, room, rng):
    view = camera_view(rng, len(room), model, terms=terms)
    poses = poses_in(room.bounds, rng, 20)
    got = score_poses(room.caster.tracer, room.surface, poses, view, model)
    whole = score_poses(
        room.caster.tracer, room.surface, poses, view._replace(terms=np.ones(3, bool)), model
    )
    asked = np.array([*terms, terms[DEPTH] and terms[COLOUR]])
    np.testing.assert_allclose(got[:, asked], whole[:, asked], rtol=1e-5, atol=1e-5)
    assert not got[:, ~asked].any()


def test_a_perfect_camera_scores_2(room, rng):
    pose = np.array([2.2, 2.1, 1.6, 0.7])
    view = camera_view(rng, len(room), PAPER)
    hits = cast(room.caster, pose, view)
    assert (hits.triangle >= 0).all()
    view = seen_by_itself(room.caster, room.surface, pose, view)
    # one patch a sample, sure of its object
    used = np.flatnonzero(view.patch >= 0)
    patch = np.full(len(view.patch), -1, np.int32)
    patch[used] = np.arange(len(used))
    semantic = np.zeros((len(used) + 1, len(room) + 1), np.float32)
    semantic[np.arange(len(used)), room.mesh.object_of[hits.triangle[used]]] = 2.0
    weight = np.append(np.ones(len(used)), 0).astype(np.float32)
    view = view._replace(patch=patch, semantic=semantic, weight=weight)
    poses = pose + np.array([[0, 0, 0, 0], [0.3, 0, 0, 0], [0, 0, 0, 0.3], [0, 0, 0.3, 0]])
    scores = score_poses(room.caster.tracer, room.surface, poses, view, PAPER)
    np.testing.assert_allclose(scores[0, :TONE], 2.0, atol=0.02)
    assert (scores[1:, :TONE] < scores[0, :TONE] - 0.05).all()
    best = score_poses(room.caster.tracer, room.surface, poses, view, CALIBRATED)
    assert (best[1:, 1:] < best[0, 1:]).all()


@MODELS
def test_a_camera_off_the_map(model, room, rng):
    """Nothing is hit: nothing is known, which is no reason for or against; Eq. 2 gives nothing."""
    view = camera_view(rng, len(room), model)
    view.semantic[:, -1] = 0.0 if model.gaussian else 1.0
    away = np.array([[500.0, 0, 1.6, 0.0], [0, 0, 400.0, 1.0], [0, 0, -50.0, 2.0]])
    away[1:, 3] = 0  # above and below, level
    scores = score_poses(room.caster.tracer, room.surface, away, view, model)
    np.testing.assert_allclose(scores, 0.0, atol=1e-6)


@MODELS
def test_frames_without_readings_or_patches_score_nothing(model, room, rng):
    view = camera_view(rng, len(room), model)
    view = view._replace(
        depth=np.zeros_like(view.depth), background_depth=np.zeros_like(view.depth),
        weight=np.zeros_like(view.weight),
    )  # fmt: skip
    scores = score_poses(
        room.caster.tracer, room.surface, poses_in(room.bounds, rng, 9), view, model
    )
    assert not scores[:, [SEMANTIC, DEPTH]].any()
    assert np.isfinite(scores).all()


@MODELS
def test_grey_images_tell_noobject_of_colour(model, room, rng):
    view = camera_view(rng, len(room), model)
    view = view._replace(colour=np.full((len(view.patch), 3), 0.5, np.float32))
    poses = poses_in(room.bounds, rng, 9)
    scores = score_poses(room.caster.tracer, room.surface, poses, view, model)
    assert np.isfinite(scores).all()
    if not model.gaussian:
        assert not scores[:, [COLOUR, TONE]].any()
    mesh = room.mesh
    plain = Mesh.plain(mesh.vertices, mesh.triangles, mesh.object_of)
    view = camera_view(rng, len(room), model)
    blank = score_poses(room.caster.tracer, Surface.of(plain), poses, view, model)
    assert np.isfinite(blank).all()
    if not model.gaussian:
        assert abs(blank[:, [COLOUR, TONE]]).max() < 1e-6


def test_tones_tell_rooms_apart_whose_steps_are_alike(boxes):
    """A wall a little brighter than the floor, and one a little darker than the ceiling.

    Depth is the same before either, and so is every step: steep ones count no more than others. That
    is how a camera in half a map of an office was put before the wrong wall, and said to be LOST.
    """
    drawn = boxes({"hall": ((0, 0, 0), (6, 4, 3))})
    corners = drawn.vertices[drawn.triangles]
    flat = corners.mean(axis=1)
    grey = np.full(len(corners), 225)
    planes = ((2, 0, 40), (2, 3, 250), (0, 6, 70), (0, 0, 200))  # floor, ceiling, east, west
    for axis, at, light in planes:
        grey[np.ptp(corners[..., axis], axis=1) + abs(flat[:, axis] - at) < 1e-6] = light
    triangles = np.arange(3 * len(corners)).reshape(-1, 3)
    colours = np.repeat(grey, 3)[:, None].repeat(3, axis=1)
    mesh = Mesh.plain(corners.reshape(-1, 3), triangles, drawn.object_of, colours)
    caster, surface = RayCaster(mesh.vertices, mesh.triangles), Surface.of(mesh)
    view = camera_view(np.random.default_rng(0), 1, CALIBRATED, terms=(False, True, True))
    poses = np.array([[3, 2, 1.5, 0], [3, 2, 1.5, np.pi]])
    seen = seen_by_itself(caster, surface, poses[0], view)
    seen = seen._replace(background_depth=np.zeros_like(seen.background_depth))
    right, wrong = score_poses(caster.tracer, surface, poses, seen, CALIBRATED)
    np.testing.assert_allclose(right[[DEPTH, COLOUR]], wrong[[DEPTH, COLOUR]], rtol=0.02)
    right, wrong = model_of(Likelihood()).combine_terms(np.array([right, wrong]), seen.terms)
    assert right > wrong + 30  # nat, of one frame


@MODELS
@pytest.mark.parametrize("count", [0, 1, 64, 65])
def test_poses_are_scored_one_by_one(model, count, room, rng):
    view = camera_view(rng, len(room), model, stride=16)
    poses = poses_in(room.bounds, rng, count)
    together = score_poses(room.caster.tracer, room.surface, poses, view, model)
    assert together.shape == (count, 4)
    for k in range(0, count, 13):
        alone = score_poses(room.caster.tracer, room.surface, poses[k : k + 1], view, model)
        np.testing.assert_array_equal(alone[0], together[k])


@pytest.mark.parametrize("distance", [0.0, 0.05, 0.3, 1.0])
def test_depth_before_a_wall_by_hand(distance, boxes):
    wall = boxes({"wall": ((2.0, -50, -50), (3.0, 50, 50))})
    mesh = Mesh.plain(wall.vertices, wall.triangles)
    tracer = RayCaster(mesh.vertices, mesh.triangles).tracer
    surface = Surface.of(mesh)
    view = View(
        directions=np.tile(np.float32([1, 0.01, 0.01]), (16, 1)),
        patch=np.zeros(16, np.int32),
        semantic=np.ones((2, 2), np.float32),
        weight=np.zeros(2, np.float32),
        depth=np.full(16, 2 - distance, np.float32),
        background_depth=np.full(16, 0.25, np.float32),
        colour=np.zeros((16, 3), np.float32),
        footprint=0.01,
        terms=np.array([False, True, False]),
    )
    pose = np.zeros((1, 4))

    def ratio(measured, cost):
        good = 1 / (1 + ((2 - measured) / (0.05 + 0.03 * measured)) ** 2)
        return 60 * (good * 3.5 - (1 - good) * cost - 0.25)

    nearer = score_poses(tracer, surface, pose, view, CALIBRATED)[0, DEPTH]
    assert nearer == pytest.approx(ratio(2 - distance, 1.5), rel=1e-3)
    beyond = view._replace(depth=np.full(16, 2 + distance, np.float32))
    farther = score_poses(tracer, surface, pose, beyond, CALIBRATED)[0, DEPTH]
    assert farther == pytest.approx(ratio(2 + distance, 2.0), rel=1e-3)
    view = view._replace(background_depth=np.zeros(16, np.float32))  # Eq. 2 knows of none
    clipped = score_poses(tracer, surface, pose, view, PAPER)[0, DEPTH]
    assert clipped == pytest.approx(2 * (1 - min(distance / 0.5, 1)), abs=1e-4)


@pytest.fixture(scope="module")
def room_views(room, walk):
    return view_frames(room, walk[:3], PoseSearchOptions(), stride=20.0)


def test_scores_are_counted(room, room_views):
    scorer = Scorer(room, Likelihood())
    poses = np.array([[2.0, 1.5, 1.6, 0.1], [2.2, 1.5, 1.6, 0.3]])
    terms = scorer.terms(poses, room_views[0])
    assert terms.shape == (2, 4)
    assert scorer.poses == 2
    assert scorer.rays == 2 * len(room_views[0].directions)
    values = scorer(poses, room_views[0])
    np.testing.assert_allclose(values, scorer.model.combine_terms(terms, room_views[0].terms))
    assert scorer.poses == 4
    assert scorer.seconds > 0


def test_a_sequence_is_scored_as_a_rig(room, room_views):
    scorer = Scorer(room, Likelihood())
    poses = np.array([[2.0, 1.5, 1.6, 0.1], [2.2, 1.5, 1.6, 0.3]])
    steps = np.array([[0, 0, 0, 0], [0.2, 0.1, 0, 0.3], [-0.1, 0, 0.02, -1.0]])
    expected = sum(scorer(compose(poses, s), v) for s, v in zip(steps, room_views, strict=True))
    np.testing.assert_allclose(scorer.together(poses, room_views, steps), expected)
    with pytest.raises(ValueError, match="shorter"):
        scorer.together(poses, room_views, steps[:2])
