import numpy as np
import pytest

from placegraph_lab.tables.outdoor.places import AREA
from placegraph_lab.tables.outdoor.queries import load, make_queries

N = 60


def stands(city, i, viewpoint):
    """Where an object stands, worked out without the bins; None where it is out of sight."""
    segments = city.segments[city.segment_starts[i] : city.segment_starts[i + 1]]
    a, b = segments[:, :2], segments[:, 2:]
    above = (a[:, 1] > viewpoint[1]) != (b[:, 1] > viewpoint[1])
    with np.errstate(all="ignore"):
        crossing = a[:, 0] + (b - a)[:, 0] * (viewpoint[1] - a[:, 1]) / (b - a)[:, 1]
    if city.kind[i] == AREA and (above & (viewpoint[0] < crossing)).sum() % 2:
        point = city.center[i]
    else:
        length2 = np.maximum(((b - a) ** 2).sum(1), 1e-12)
        t = np.clip(((viewpoint - a) * (b - a)).sum(1) / length2, 0.0, 1.0)
        points = a + t[:, None] * (b - a)
        point = points[np.argmin(np.hypot(*(points - viewpoint).T))]
    return point if np.hypot(*(point - viewpoint)) <= 25.0 + 1e-6 else None


def direction(delta):
    east, north = delta
    if abs(east) <= abs(north):
        return "north" if north > 0 else "south"
    return "east" if east > 0 else "west"


@pytest.mark.parametrize("setting", ["none", "synonyms", "names"])
def test_every_statement_without_noise_is_true(town, setting):
    city = load(town).city
    label = city.named if setting == "names" else city.label
    for query in make_queries(town, setting=setting, n=N):
        viewpoint = city.plane.to_plane((query.longitude, query.latitude))
        assert len(query.statements) == 6
        for said in query.statements:
            a, b = city.rows[said.source_osm], city.rows[said.target_osm]
            p, q = stands(city, a, viewpoint), stands(city, b, viewpoint)
            assert p is not None
            assert q is not None
            assert 1.0 - 1e-6 <= np.hypot(*(p - q)) <= 25.0 + 1e-6
            assert direction(p - q) == said.direction
            assert (city.labels[label[a]], city.labels[label[b]]) == (said.source, said.target)
            assert said.source != said.target
            assert not said.noisy


def test_statements_about_the_speaker_are_true(town):
    city = load(town).city
    for query in make_queries(town, setting="speaker", n=N):
        viewpoint = city.plane.to_plane((query.longitude, query.latitude))
        assert query.text.count("There ") == 6
        for said in query.statements:
            point = stands(city, city.rows[said.source_osm], viewpoint)
            assert point is not None
            assert direction(point - viewpoint) == said.direction
            assert f"{said.source.replace('_', ' ')} to my {said.direction}." in query.text


def test_noise_changes_a_fifth_of_the_same_statements(town):
    true = make_queries(town, n=200)
    for setting in ("replaced", "absent"):
        noisy = make_queries(town, setting=setting, n=200)
        pairs = []
        for p, q in zip(true, noisy, strict=True):
            assert (p.longitude, p.latitude) == (q.longitude, q.latitude)
            pairs += zip(p.statements, q.statements, strict=True)
        changed = [(a, b) for a, b in pairs if b.noisy]
        assert 0.16 < len(changed) / len(pairs) < 0.24  # 0.2 +- 3.5 standard deviations
        assert all(a == b for a, b in pairs if not b.noisy)
        for a, b in changed:
            if setting == "replaced":
                assert (a.source, a.target) == (b.source, b.target)
                assert a.direction != b.direction
            else:
                assert a.direction == b.direction
                assert (a.source != b.source) != (a.target != b.target)


def test_absent_things_are_not_there(town):
    bins = load(town)
    for query in make_queries(town, setting="absent", n=N):
        viewpoint = bins.city.plane.to_plane((query.longitude, query.latitude))
        around = bins.around(viewpoint[None], 60.0)
        near = {bins.city.labels[i] for i in bins.city.label[around.objects]}
        for said in query.statements:
            ends = ((said.source, said.source_osm), (said.target, said.target_osm))
            absent = [label for label, osm in ends if not osm]
            assert len(absent) == said.noisy
            assert not near.intersection(absent)
