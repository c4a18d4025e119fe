"""Recorded runs: small files, read back as the estimate they were made of."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.estimate import PassRecord, PoseEstimate, PoseMode, Status
from placegraph.core.mapfile import read_map, write_map
from placegraph.errors import InputError, MapError
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.pose.record import KIND, STEPS, VERSION, read_run, write_run


def made(passes=2, frames=3, particles=50, modes=2):
    rng = np.random.default_rng(3)

    def step(frame):
        count = particles + frame
        return 7 + frame, rng.normal(0, 3, (count, 4)), rng.random(count)

    history = tuple(PassRecord(2.0**-k, tuple(map(step, range(frames)))) for k in range(passes))
    matrix = np.eye(4)
    matrix[:3, 3] = 1, 2, 3
    return PoseEstimate(
        status=Status.AMBIGUOUS,
        modes=tuple(
            PoseMode(matrix, np.array([1, 2, 3, k]), np.eye(6) * k, 0.5, f"scene {k}", np.eye(4))
            for k in range(modes)
        ),
        reason="Two places fit.",
        trajectory=np.broadcast_to(matrix, (frames, 4, 4)),
        frames=np.arange(7, 7 + frames),
        history=history,
    )


@pytest.mark.parametrize("sizes", [(2, 3, 50, 2), (0, 0, 0, 0), (1, 1, 0, 1), (1, 0, 5, 1)])
def test_there_and_back(tmp_path, sizes):
    estimate = made(*sizes)
    write_run(tmp_path / "a.run", estimate, source="house.glb")
    back = read_run(tmp_path / "a.run")
    assert (back.status, back.reason) == (estimate.status, estimate.reason)
    assert (back.trajectory == estimate.trajectory).all()
    assert back.frames.tolist() == estimate.frames.tolist()
    for one, other in zip(back.modes, estimate.modes, strict=True):
        assert (one.scene, one.probability) == (other.scene, other.probability)
        for name in ("map_from_camera", "pose", "covariance", "scene_from_camera"):
            assert (getattr(one, name) == getattr(other, name)).all()
    for one, other in zip(back.history, estimate.history, strict=True):
        assert one.stride == other.stride
        for found, made_of in zip(one.steps, other.steps, strict=True):
            assert found[0] == made_of[0]
            assert np.all(np.abs(found[1] - made_of[1]) <= STEPS / 2 + 1e-12)
            relative = made_of[2] / made_of[2].max(initial=1e-9)
            assert found[2] == pytest.approx(relative, abs=1e-4)


def test_weights_may_all_be_zero(tmp_path):
    estimate = made(1, 1, 4)
    frame, poses, _ = estimate.history[0].steps[0]
    estimate.__dict__["history"] = (PassRecord(1.0, ((frame, poses, np.zeros(4)),)),)
    write_run(tmp_path / "a.run", estimate)
    assert not read_run(tmp_path / "a.run").history[0].steps[0][2].any()


@pytest.mark.usefixtures("one_thread")
def test_a_run_of_the_filter(room, walk, tmp_path):
    options = FilterOptions(record=True)
    estimate = room.localize(walk[:4], options=options, refine=False)
    write_run(tmp_path / "a.run", estimate, source=room.source)
    back = read_run(tmp_path / "a.run")
    assert len(back.history) == len(options.passes)
    counts = [len(poses) for record in back.history for _, poses, _ in record.steps]
    assert counts == [len(poses) for record in estimate.history for _, poses, _ in record.steps]
    assert (tmp_path / "a.run").stat().st_size < 10 * sum(counts) + 4000


def test_what_is_no_run(tmp_path, room):
    with pytest.raises(InputError, match="scene localize --record"):
        read_run(tmp_path / "no.run")
    (tmp_path / "a.run").write_bytes(b"")
    with pytest.raises(InputError, match="empty"):
        read_run(tmp_path / "a.run")
    room.save(tmp_path / "room.scene")
    with pytest.raises(MapError, match="is a scene map, not a run"):
        read_run(tmp_path / "room.scene")


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("particle_counts", np.array([4, 4])), ("particle_counts", np.array([-1, 5, 5, 5, 5, 5])),
        ("pass_steps", np.array([9])), ("weights", np.zeros(3, np.uint16)),
        ("frames", np.zeros(2, np.int64)), ("mode_poses", np.zeros((1, 4))),
        ("mode_poses", np.full((2, 4), np.nan)), ("mode_covariances", np.full((2, 36), np.inf)),
        ("mode_matrices", np.full((2, 16), 1e30)), ("mode_probabilities", np.array([0.9, 0.9])),
        ("mode_probabilities", np.array([0.5, np.nan])), ("particles", np.zeros((9, 3), np.int32)),
        ("trajectory", None),
    ],
)  # fmt: skip
def test_columns_that_contradict_each_other(tmp_path, name, values):
    path = tmp_path / "a.run"
    write_run(path, made())
    file = read_map(path, KIND, VERSION)
    arrays = dict(file.arrays)
    arrays.pop(name)
    if values is not None:
        arrays[name] = values
    write_map(path, KIND, VERSION, file.meta, arrays)
    with pytest.raises(MapError, match=r"a\.run"):
        read_run(path)


@given(st.integers(0, 3000))
def test_truncated_files(tmp_path_factory, run_bytes, at):
    path = tmp_path_factory.getbasetemp() / "a.run"
    path.write_bytes(run_bytes[: min(at, len(run_bytes) - 1)])
    with pytest.raises((InputError, MapError), match=r"a\.run"):
        read_run(path)


@pytest.fixture(scope="module")
def run_bytes(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "a.run"
    write_run(path, made())
    return path.read_bytes()


def test_numbers_too_large_for_a_float(tmp_path):
    write_run(tmp_path / "a.run", made())
    file = read_map(tmp_path / "a.run", KIND, VERSION)
    write_map(
        tmp_path / "a.run", KIND, VERSION, file.meta | {"strides": [10**400] * 2}, file.arrays
    )
    with pytest.raises(MapError, match="contradict"):
        read_run(tmp_path / "a.run")
