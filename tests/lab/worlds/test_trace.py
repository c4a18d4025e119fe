from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from placegraph_lab.worlds.drawing import ORTHOGONAL, blots, step, strokes

cells = st.sets(st.tuples(st.integers(0, 7), st.integers(0, 7)), min_size=1)


@given(cells)
def test_blots_part_the_cells(drawn):
    found = blots(drawn)
    assert sum(map(len, found)) == len(drawn)
    assert set().union(*found) == drawn
    for blot in found:
        around = {step(cell, d) for cell in blot for d in ORTHOGONAL} - blot
        assert not around & drawn


@given(cells)
def test_strokes_walk_every_edge_once(drawn):
    links = {
        cell: [n for d in ORTHOGONAL if (n := step(cell, d)) in drawn]
        for cell in drawn
        if any(step(cell, d) in drawn for d in ORTHOGONAL)
    }
    edges = sorted(tuple(sorted((a, b))) for a, arms in links.items() for b in arms)
    walked = sorted(tuple(sorted(edge)) for line in strokes(links) for edge in pairwise(line))
    assert walked == sorted(set(edges))
