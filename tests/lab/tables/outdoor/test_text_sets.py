import tomllib

import numpy as np
import pytest

from placegraph_lab.tables.named.statuses import TRAPS, Filler, Verdict, diagrams, logistic, rates
from placegraph_lab.tables.statistics import reliability


def test_every_gap_is_filled_with_what_the_map_lacks(harbour):
    kinds = tomllib.loads(TRAPS.read_text(encoding="utf-8"))
    known = next(n for n in harbour.objects.names if " " in n)
    foreign = ["King Street West", "Xyzal Motors", known]
    filler = Filler.of(harbour, foreign, kinds["words"]["made"])
    assert filler.gaps["street"] == ["King Street West"]
    assert filler.gaps["business"] == ["Xyzal Motors"]
    for kind in kinds.values():
        for frame in kind["frames"]:
            text = filler.fill(frame, np.random.default_rng(0))
            assert "{" not in text
            assert filler.fill(frame, np.random.default_rng(0)) == text


def test_rates():
    verdicts = [Verdict("OK", 0.9, 10.0), Verdict("OK", 0.8, 60.0)]
    verdicts += [Verdict("AMBIGUOUS", 0.4, 20.0), Verdict("LOST", 0.0, np.inf)]
    found = rates(verdicts, 50.0)
    assert (found["ok"], found["wrong_of_ok"], found["ok_and_right"]) == (0.5, 0.5, 0.25)
    assert (found["right_not_ok"], found["lost"], found["right"]) == (0.25, 0.25, 0.5)
    assert rates(verdicts, 100.0)["wrong_of_ok"] == 0.0
    assert rates(verdicts[3:], 50.0)["wrong_of_ok"] == 0.0


@pytest.mark.parametrize("many", [1, 3])
def test_a_diagram_is_a_panel_wide(many):
    rng = np.random.default_rng(0)
    sure = rng.random(100)
    image = diagrams({str(k): reliability(sure, rng.random(100) < sure) for k in range(many)})
    assert image.width == many * diagrams({"": reliability(sure, sure > 0.5)}).width
    assert len(np.unique(np.asarray(image))) > 10, "something is drawn"


def test_the_fit_finds_how_far_odds_were_shrunk():
    rng = np.random.default_rng(0)
    share = rng.uniform(0.01, 0.99, 20_000)
    p = 1.0 / (1.0 + np.exp(0.5 - 0.4 * np.log(share / (1.0 - share))))
    trust = logistic(share, rng.random(len(p)) < p)
    assert (trust.level, trust.slope) == pytest.approx((-0.5, 0.4), abs=0.05)
