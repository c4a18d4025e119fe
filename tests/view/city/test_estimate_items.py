"""Heat, ellipses and witnesses stand where the estimate says."""

import numpy as np
import pytest

from placegraph.core.estimate import Status
from placegraph.view.city.city_items import (
    SIGMAS,
    ellipse,
    evidence_marks,
    heat_of,
    mode_bounds,
    place_of,
    rivals,
    row_of,
    witnesses,
)
from placegraph.view.draw.canvas import Disc, Stroke


def test_ellipse_holds_the_stated_deviations(city, sure):
    mode = sure.modes[0]
    delta = ellipse(city, mode) - place_of(city, mode)
    mahalanobis = np.einsum("ni,ij,nj->n", delta, np.linalg.inv(mode.covariance), delta)
    assert np.allclose(np.sqrt(mahalanobis), SIGMAS)


def test_heat_peaks_at_the_heaviest_mode(city, sure):
    mode = place_of(city, sure.modes[0])
    bounds = (*(mode - 80.0).tolist(), *(mode + 80.0).tolist())
    glow = heat_of(city, sure, bounds, 2.0)
    assert glow.density.shape == (80, 80)
    row, column = np.unravel_index(np.argmax(glow.density), glow.density.shape)
    peak = np.array([bounds[0] + (column + 0.5) * 2.0, bounds[3] - (row + 0.5) * 2.0])
    assert np.hypot(*(peak - mode)) < 4.0
    assert 0.5 < glow.density.max() <= 1.0 + 1e-9


def test_a_faint_posterior_is_faint(city, estimate_of):
    faint = estimate_of(Status.LOST, 0.01)
    bounds = mode_bounds(city, faint.modes[0])
    assert heat_of(city, faint, bounds, 2.0).density.max() < 0.1


def test_no_heat_far_away(city, sure):
    assert heat_of(city, sure, (9000.0, 9000.0, 9100.0, 9100.0), 2.0) is None


def test_witnesses_are_the_objects_of_telling_statements(city, sure, town):
    seen = witnesses(city, sure.modes[0])
    assert [w.verdict for w in seen] == ["for", "against"]
    assert seen[0].words == '<script>alert("K")</script>'
    here = place_of(city, sure.modes[0])
    bakery = city.plane.to_plane(town.position("K"))
    assert np.allclose(seen[0].at, bakery, atol=1.0)
    # the church is an area: its nearest corner, not its centre
    assert np.hypot(*(seen[1].at - here)) < np.hypot(*(seen[1].middle - here))


def test_marks_join_witnesses_to_the_mode(city, sure):
    mode = sure.modes[0]
    marks = evidence_marks(city, mode)
    at = place_of(city, mode)
    joined = [m for m in marks if isinstance(m, Stroke) and np.allclose(m.points[0], at)]
    assert {(m.color, m.dash is None) for m in joined} == {("for", True), ("against", False)}
    assert sum(isinstance(m, Disc) for m in marks) == 2


@pytest.mark.parametrize("osm", ["", "way", "way/", "way/-1", "star/1", "node/999999999"])
def test_unknown_ids_have_no_row(city, osm):
    assert row_of(city.objects, osm) == -1


def test_ids_lead_to_their_rows(city):
    rows = list(range(len(city.objects)))
    assert [row_of(city.objects, city.objects.osm(i)) for i in rows] == rows


def test_rivals_are_about_as_probable(estimate_of):
    estimate = estimate_of(Status.AMBIGUOUS, 0.5, 0.3, 0.02)
    assert len(rivals(estimate, 4)) == 2
    assert len(rivals(estimate, 1)) == 1
    assert rivals(estimate_of(Status.LOST), 4) == ()
