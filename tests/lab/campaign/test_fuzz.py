import signal
from pathlib import Path

import pytest

from placegraph_lab.campaign import worker
from placegraph_lab.campaign.fuzz import rows, run_targets
from placegraph_lab.campaign.row import Effort
from placegraph_lab.campaign.targets import Target, find_targets
from placegraph_lab.campaign.uses import Bench
from placegraph_lab.campaign.worker import Trials

LAYOUTS = Path(__file__).with_name("layouts.py")
MINUTES = 4.0
"""Of the long test; `placegraph-lab table reliability --only fuzz --minutes 240` takes longer."""


@pytest.fixture
def effort(tmp_path):
    def of(seconds, seed=20261123):
        return Effort(seconds, seed, tmp_path, tmp_path / "none", print, layouts=LAYOUTS)

    return of


@pytest.mark.all
def test_nothing_breaks(effort):
    found = list(rows(effort(60.0 * MINUTES)))
    assert len(found) == len(find_targets(LAYOUTS))
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
    found = [made.run(number) for number in range(30)]
    assert {o.outcome for o in found} == {"accepted", "untyped"}
    assert [made.run(number).outcome for number in range(30)] == [o.outcome for o in found]
    assert any("RuntimeError" in o.reason for o in found)


def test_memory_beyond_the_bound_is_told(trials, monkeypatch):
    monkeypatch.setattr(worker, "FREE", 8 << 20)
    kept = []
    made = trials(lambda *_: kept.append(b"x" * (120 << 20)))
    assert made.run(0).outcome == "memory"
    assert "MB" in made.run(1).reason


def test_a_worker_that_dies_is_counted_and_replaced(effort, monkeypatch):
    code = (
        "import sys, os\n"
        "for line in sys.stdin:\n"
        "    name, first, count = line.split('\\t')\n"
        '    print(\'{"seeds": 1, "refused": []}\', flush=True)\n'
        "    for n in range(int(first), int(first) + int(count)):\n"
        "        if n % 3 == 2: os.abort()\n"
        '        print(\'{"outcome": "typed", "reason": "", "bytes": 1}\', flush=True)\n'
        "    print('{\"done\": 1}', flush=True)\n"
    )
    monkeypatch.setattr("placegraph_lab.campaign.fuzz.PROGRAM", ("-c", code))
    ((_, tally),) = run_targets(effort(60.0), ["GLB"], most=8)
    assert tally.counts == {"typed": 6, "crash": 2}
    (what,) = tally.faults
    assert signal.strsignal(signal.SIGABRT) in what
    assert tally.faults[what] == [2, 5]


@pytest.mark.parametrize(
    "name", ["capture folder", "bags db3", ".scene", "PLY", "Spark-DSG", "worlds in shards"]
)
def test_the_labs_own_seeds_are_accepted(name, tmp_path):
    bench = Bench(tmp_path)
    assert Trials(find_targets()[name], tmp_path, 7, bench).warm() == []


def test_layouts_of_a_file_add_seeds():
    own, every = find_targets(), find_targets(LAYOUTS)
    assert own.keys() < every.keys()
    assert own["PLY"].seeds.keys() < every["PLY"].seeds.keys()
