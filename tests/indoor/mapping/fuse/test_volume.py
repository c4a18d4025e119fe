"""The hash of blocks, and which readings are believed."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from placegraph.indoor.mapping import fuse_kernels as kernels
from placegraph.indoor.mapping.fuse_kernels import facets_of

EYE = np.array([90.0, 90.0, 60.0, 45.0])


@given(arrays(np.int32, (60, 3), elements=st.integers(-5, 5) | st.integers(-(1 << 19), 1 << 19)))
def test_blocks_are_found_again(places):
    places = np.unique(places, axis=0)
    keys, rows = np.full(256, -1, np.int64), np.zeros(256, np.int32)
    kernels.rehash(keys, rows, places, len(places))
    found = [kernels.row_of(keys, rows, *place) for place in places.tolist()]
    assert found == list(range(len(places)))
    assert kernels.row_of(keys, rows, (1 << 19) + 1, 0, 0) == -1
    assert kernels.row_of(keys, rows, 1 << 40, 0, 0) == -1


def test_a_slanted_plane_is_no_edge(scene):
    frame, _ = scene.plane_view(2.0, slope=1.2)
    facets = facets_of(frame.depth(), EYE, 9.0, True)
    assert (facets[:, :-2, 4] > 0).all()  # the last two columns lack neighbours, far and steep
    normal = np.array([-1.2, 0.0, 1.0]) / np.hypot(1, 1.2)
    assert np.abs(facets[facets[..., 4] > 0][:, :3] - normal).max() < 1e-3


def test_readings_between_two_surfaces_are_dropped(scene):
    frame, _ = scene.plane_view(1.0)
    depth = frame.depth().copy()
    depth[:, 60:] = 3.0
    depth[:, 60] = 2.0  # a mean of both sides
    kept = {edges: facets_of(depth, EYE, 9.0, edges)[..., 4] for edges in (True, False)}
    assert (kept[True][:, 60] == 0).all()
    assert (kept[True][:, :58] > 0).all()
    assert (kept[True][:, 63:] > 0).all()
    assert (kept[True] > 0).sum() < (kept[False] > 0).sum()


def test_small_holes_are_bridged_and_specks_are_not_believed(scene):
    frame, _ = scene.plane_view(1.5, slope=0.3)
    whole = frame.depth()
    depth = whole.copy()
    depth[20:22, :] = np.nan
    depth[60:, :] = np.nan
    depth[70, 70] = 1.0
    facets = facets_of(depth, EYE, 9.0, True)
    assert np.abs(facets[20:22, 5:-5, 4] - whole[20:22, 5:-5]).max() < 1e-3
    assert (facets[62:, :, 4] == 0).all()
    assert (facets_of(whole, EYE, 1.0, True)[..., 4] == 0).all()
