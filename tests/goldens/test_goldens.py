"""Answers are those that were frozen before code moved: see `golden.py`."""

import sys
from pathlib import Path

import pytest
from llvmlite.binding import get_host_cpu_name

sys.path.insert(0, str(Path(__file__).parent))

import golden
from golden_answers import differences

FROZEN_ON = "znver5"
"""Processor that poses and scenes were written on: another one adds sums in another order."""
elsewhere = pytest.mark.skipif(
    get_host_cpu_name() != FROZEN_ON, reason=f"poses are of {FROZEN_ON}: others round otherwise"
)


@pytest.fixture(scope="session")
def worlds(tmp_path_factory):
    return golden.Worlds(tmp_path_factory.mktemp("goldens"))


def test_town(worlds):
    assert golden.compared("town", worlds) == []


@elsewhere
def test_few(worlds, shared):  # noqa: ARG001  # skips without
    assert golden.compared("few", worlds) == []


@pytest.mark.all
@pytest.mark.parametrize(
    "group",
    [
        pytest.param(g, marks=elsewhere if g in golden.golden_indoor.GROUPS else ())
        for g in golden.GROUPS if g not in golden.FAST
    ],
)  # fmt: skip
def test_all(worlds, shared, group):  # noqa: ARG001  # skips without
    assert golden.compared(group, worlds) == []


def test_a_changed_digit_shows():
    kept = {"a": {"p": 0.1234, "cell": "c1r2", "at": [1.000001, 2.0]}}
    last = {"p": 0.1235, "cell": "c1r2", "at": [1.000001, 2.0]}
    assert list(differences(kept, {"a": last})) == []
    for changed in (
        {"p": 0.1236, "cell": "c1r2", "at": [1.000001, 2.0]},
        {"p": 0.1234, "cell": "c1r3", "at": [1.000001, 2.0]},
        {"p": 0.1234, "cell": "c1r2", "at": [1.000003, 2.0]},
        {"p": 0.1234, "cell": "c1r2", "at": [1.000001]},
        {"p": 0.1234, "cell": "c1r2"},
    ):
        assert len(list(differences(kept, {"a": changed}))) == 1, changed
