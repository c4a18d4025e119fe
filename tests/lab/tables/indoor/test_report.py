import math

from placegraph.indoor.options import PoseSearchOptions
from placegraph_lab.tables.indoor.bench import house_jobs, office_jobs
from placegraph_lab.tables.indoor.metrics import Answer
from placegraph_lab.tables.indoor.report import Row, errors
from placegraph_lab.tables.named.indoor_filter import report
from placegraph_lab.tables.runner import plain

JOBS = {job.name: job for job in [*house_jobs(), *office_jobs()]}


def answer(window="seq00 0:5", position=0.05, rotation=1.0, status="OK", **more):
    near = position <= 0.5 and rotation <= 10
    return Answer(
        **{
            "window": window, "place": window.split()[0], "changed": window >= "seq01",
            "coverage": None, "position": position, "rotation": rotation, "status": status,
            "probability": 0.9, "among_modes": near, "whitened": (1.0,) * 6, "frames": 5,
            "seconds": 0.5, "particles": 120.0,
        }
        | more
    )  # fmt: skip


def lines(text, start):
    return [
        [c.strip() for c in line.strip("|").split("|")]
        for line in text.splitlines()
        if line.startswith(f"| {start}")
    ]


def test_every_row_has_a_name_of_its_own():
    assert len(JOBS) == len(house_jobs()) + len(office_jobs())
    assert JOBS["none: depth"].options == PoseSearchOptions(semantic=False, colour=False)
    assert JOBS["instances: all"].options == PoseSearchOptions()


def test_a_row_is_written():
    row = Row(JOBS["instances: semantic"], 5, (answer(), answer("seq01 0:5", 0.2, 3.0)))
    text = report([row])
    ours = lines(text, "semantic ")[0]
    assert ours[1:6] == ["2", "12.5 cm, 2.0°", "12.5 cm, 2.0°", ".50/.50/1.00/1.00", "1.00"]
    assert ours[-2:] == ["120", "0.100"]
    assert lines(text, "instances: semantic")[0][1] == "1.00/.00"  # unchanged / changed


def test_the_office_is_told_apart_by_coverage():
    answers = (
        answer("b 1", coverage=0.9, changed=None),
        answer("b 2", coverage=0.7, changed=None, position=3.0),
        answer("b 3", coverage=0.2, changed=None, position=math.inf, rotation=180.0, status="LOST"),
    )
    text = report([Row(JOBS["b in a: depth + colour"], 10, answers)])
    (covered,) = lines(text, "depth + colour: covered to 60%")
    (rest,) = lines(text, "depth + colour: the others")
    assert (covered[1], covered[4]) == ("2", ".50/.50/.50/.50")
    assert (rest[1], rest[8]) == ("1", "1.00")
    row = plain(Row(JOBS["b in a: depth + colour"], 10, answers).record())
    assert row["parts"]["covered 60%"]["windows"] == 2


def test_short_numbers_of_errors():
    assert errors((0.0212, 0.44)) == "2.1 cm, 0.4°"
    assert errors((2.5, 20.0)) == "2.50 m, 20.0°"
    assert errors((2.05e12, 46.68)) == "2.05e+12 m, 46.7°"
    assert errors((math.inf, 180.0)) == "∞, 180.0°"
    assert errors((None, 3.0)) == errors((math.nan, math.nan)) == "–"
