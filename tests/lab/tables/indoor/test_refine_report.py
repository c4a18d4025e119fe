"""Tables of the refinement's benchmark."""

import json

from placegraph_lab.tables.indoor.metrics import Answer, dumps
from placegraph_lab.tables.indoor.refine import Refined, refine_jobs
from placegraph_lab.tables.named.indoor_refine import RefineRow, refine_report

JOBS = {job.name: job for job in refine_jobs()}


def result(window="seq00 0:10", position=0.01, rotation=0.2, before=(0.2, 10.0), **more):
    fields = {"accepted": True, "sigmas": (0.5,) * 6, "stages": {"depth": 0.4}} | more
    coverage = fields.pop("coverage", None)
    place = window.rpartition(" ")[0]
    after = Answer(
        window=window, place=place, changed=None if coverage else window >= "seq01",
        coverage=coverage, position=position, rotation=rotation, status="OK", probability=0.9,
        held=True, whitened=(0.5,) * 6, frames=10, seconds=0.5,
    )  # fmt: skip
    return Refined(before, after, **fields)


def lines(text, start):
    return [
        [c.strip() for c in line.strip("|").split("|")]
        for line in text.splitlines()
        if line.startswith(f"| {start}")
    ]


def row(name, *results, length=10):
    return RefineRow(JOBS[name], length, results)


def test_a_line_has_both_sides():
    text = refine_report(
        [row("house found: all, sift", result(before=(0.06, 1.0)), result(position=0.3))]
    )
    assert "#### House, from the pose found, 10 frames" in text
    (ours,) = lines(text, "all, sift")
    assert ours[1:8] == [
        "2", "13.0 cm, 5.5°", "15.5 cm, 0.2°", "13.0 cm, 5.5°", "15.5 cm, 0.2°",
        ".50/.50/.50/1.00", ".50/.50/.50/.50",
    ]  # fmt: skip
    assert ours[8:] == ["1.00", ".50", ".00", "0.40", "0.50"]
    assert "- house found: all, sift, 10 frames: seq00 0:10 OK 0.20 m" in text


def test_the_office_shows_what_its_map_covers():
    results = (
        result("b in a 0:9", coverage=0.9),
        result("b in a 9:18", coverage=0.2, position=2.0),
    )
    text = refine_report([row("b in a disturbed: depth, auto", *results)])
    (inside,) = lines(text, "depth, auto: covered to 60%")
    assert (inside[1], inside[7]) == ("1", "1.00/1.00/1.00/1.00")
    assert lines(text, "b in a disturbed: depth, auto, 10 frames: 25 cm")[0][1:] == ["≥ .70", ".50"]
    written = json.loads(dumps(row("b in a disturbed: depth, auto", *results).to_dict()))
    assert written["parts"]["covered 60%"]["windows"] == 1
    assert written["parts"]["not covered"]["windows"] == 1


def test_covariances_are_shown_for_poses_refined_and_poses_left():
    kept = result(accepted=False, sigmas=(4.0,) * 6)
    text = refine_report([row("house disturbed: depth, auto", result(), kept)])
    (refined,) = lines(text, "house disturbed: depth, auto: refined")
    (left,) = lines(text, "house disturbed: depth, auto: left coarse")
    assert refined[1:] == ["1", *["0.50"] * 6, "1.00/1.00/1.00", "1.00"]
    assert left[1:3] == ["1", "4.00"]
    assert left[8] == ".00/.00/.00"
    bars = "#### Errors over standard deviations: House, depth (with depth), from 0.2 m"
    assert text.count(bars) == text.count("```text") == 1
