import numpy as np

from placegraph_lab.tables.outdoor.extracts import tile


def rows_of(city):
    """Objects by id, as plain values."""
    o = city.objects
    return {
        o.osm(i): (o.label(i), o.name(i), o.kind[i], [p.tolist() for p in o.parts(i)])
        for i in range(len(o))
    }


def test_copies_stand_apart_and_differ(harbour):
    city = harbour
    three = tile(city, 3, np.random.default_rng(0))
    three.objects.check()
    n = len(city.objects)
    assert len(three.objects) == 3 * n
    assert len(set(three.objects.osm_id)) >= 3 * len(set(city.objects.osm_id))
    original, first = rows_of(city), rows_of(three)
    assert all(first[osm] == row for osm, row in original.items())  # the first is as it was
    for k in (1, 2):
        copy = slice(k * n, (k + 1) * n)
        labels = [three.objects.label(i) for i in range(k * n, (k + 1) * n)]
        assert sorted(labels) == sorted(city.objects.label(i) for i in range(n))
        assert labels != [city.objects.label(i) for i in range(n)]
        shift = three.objects.center[copy] - city.objects.center
        assert np.ptp(shift, axis=0).max() < 0.01
    spans = [three.objects.center[k * n : (k + 1) * n] for k in range(3)]
    assert spans[1][:, 0].min() > spans[0][:, 0].max() + 100.0
    assert spans[2][:, 1].min() > spans[0][:, 1].max() + 100.0
    # stones' throws are kept: every copy has as many cells
    assert abs(len(three.cells) - 3 * len(city.cells)) <= 0.05 * len(three.cells)
