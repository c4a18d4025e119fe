"""Readers and endpoints under mutated inputs: no untyped error, no crash, no hang, no hunger."""

import importlib
import os
import signal

import pytest

from placegraph_lab.campaign import worker
from placegraph_lab.campaign.fuzz import rows, tallies
from placegraph_lab.campaign.row import Effort
from placegraph_lab.campaign.targets import TARGETS, Target
from placegraph_lab.campaign.worker import Trials

MINUTES = 4.0
"""Of the long test; `placegraph-lab table reliability --only fuzz --minutes 240` takes longer."""


@pytest.fixture
def effort(tmp_path):
    def of(seconds, seed=20261123):
        return Effort(seconds, seed, tmp_path, tmp_path / "none", print)

    return of


@pytest.mark.all
def test_nothing_breaks(effort):
    found = list(rows(effort(60.0 * MINUTES)))
    assert len(found) == len(TARGETS)
    assert [row for row in found if row.faults] == []
    assert sum(row.typed for row in found) > sum(row.tried for row in found) // 10


@pytest.fixture
def trials(tmp_path):
    def of(use):
        target = Target("t", {"a.txt": lambda path, _: path.write_text("1 2 3\n" * 9)}, use)
        return Trials(target, tmp_path, 7, None)

    return of


def test_what_becomes_of_an_input_is_told(trials):
    def use(_bench, path, rng):
        assert path.read_bytes() != b"1 2 3\n" * 9
        if rng.random() < 0.5:
            raise RuntimeError("oh")

    made = trials(use)
    found = [made.take(number) for number in range(30)]
    assert {o.outcome for o in found} == {"accepted", "untyped"}
    assert [made.take(number).outcome for number in range(30)] == [o.outcome for o in found]
    assert any("RuntimeError" in o.said for o in found)


def test_memory_beyond_the_bound_is_told(trials, monkeypatch):
    monkeypatch.setattr(worker, "FREE", 8 << 20)
    kept = []
    made = trials(lambda *_: kept.append(os.urandom(120 << 20)))
    assert made.take(0).outcome == "memory"
    assert "MB" in made.take(1).said


def test_a_worker_that_dies_is_counted_and_replaced(effort, monkeypatch):
    """The worker's program is another one here: it dies of each third input."""
    program = importlib.import_module("placegraph_lab.campaign.fuzz")
    code = (
        "import sys, os\n"
        "for line in sys.stdin:\n"
        "    name, first, count = line.split('\\t')\n"
        '    print(\'{"seeds": 1, "refused": []}\', flush=True)\n'
        "    for n in range(int(first), int(first) + int(count)):\n"
        "        if n % 3 == 2: os.abort()\n"
        '        print(\'{"outcome": "typed", "said": "", "bytes": 1}\', flush=True)\n'
        "    print('{\"done\": 1}', flush=True)\n"
    )
    monkeypatch.setattr(program, "PROGRAM", ("-c", code))
    effort_ = effort(60.0)
    ((_, tally),) = tallies(effort_, ["GLB"], most=8)
    assert tally.counts == {"typed": 6, "crash": 2}
    (what,) = tally.found
    assert signal.strsignal(signal.SIGABRT) in what
    assert tally.found[what] == [2, 5]
