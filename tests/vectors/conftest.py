"""Clouds of vectors, and what numpy alone finds in them."""

import numpy as np
import pytest


def make_cloud(rng, count, dimension=8, box=(7.40, 43.72, 7.44, 43.76)):
    """Ids out of order and with gaps, vectors of any length, positions within a box."""
    west, south, east, north = box
    ids = 3 * rng.permutation(count)
    vectors = rng.standard_normal((count, dimension)) * rng.uniform(0.1, 9.0, (count, 1))
    lonlat = np.stack([rng.uniform(west, east, count), rng.uniform(south, north, count)], 1)
    return ids, vectors, lonlat


@pytest.fixture(scope="session")
def cloud():
    return make_cloud


def brute(ids, vectors, queries, n, inside=None):
    """What numpy alone finds: ids and cosines, equal ones by ascending id."""
    a = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    b = queries / np.linalg.norm(queries, axis=1, keepdims=True)
    cosines = b @ a.T
    if inside is not None:
        cosines[:, ~inside] = -np.inf
    order = np.lexsort((np.broadcast_to(ids, cosines.shape), -cosines), axis=1)[:, :n]
    found, best = ids[order], np.take_along_axis(cosines, order, axis=1)
    found[best == -np.inf] = -1
    return found, best


@pytest.fixture(scope="session")
def exact():
    return brute
