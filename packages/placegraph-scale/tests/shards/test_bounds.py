import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import placegraph as pg
from placegraph_scale.shards import search
from placegraph_scale.shards import search as bounds
from placegraph_scale.shards.search import CandidatePool
from shards_world import shards_of

SHARES = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=30)


@given(SHARES, st.floats(0.0, 16.0), st.sampled_from(bounds._NORMS))
def test_a_norm_is_bounded_by_peak_and_mean(shares, log_gain, k):
    shares = np.array(shares)
    worth = bounds._gains([(np.exp(log_gain), 0, bounds.ME)], 1, 1.0)
    true = np.log(((1.0 + np.exp(log_gain) * shares) ** k).mean()) / k
    at = np.searchsorted(bounds._SHARES, shares.max())
    found = bounds._bound_norms(worth[None], np.array([[at]]), np.array([[shares.mean()]]), k)
    assert found[0, 0, 0] >= true - 1e-9


def test_no_shard_weighs_more_than_its_bound(sharded, monkeypatch):
    planet, seen = pg.open_world(sharded), []
    real = search.Search.run

    def run(self, asked, log_mass, cores):
        found = real(self, asked, log_mass, cores)
        for row in np.flatnonzero(~self._near_rare(asked, cores)).tolist():
            one = CandidatePool(asked)
            for _, proposed in self.each("propose", [(row, (asked, -np.inf, 512))]):
                one.add(row, proposed)
            one.drawn = 1 << 20
            self._compare(one, one.list_unscored(one.drawn))
            weights, _ = one._others()
            seen.append((np.logaddexp.reduce([one.weight, *weights]), self.reach[row]))
        return found

    monkeypatch.setattr(search.Search, "run", run)
    for text in (
        "A bench is north of me. A tree is east of me. A bakery is south of me.",
        "The cafe is on the north of a bakery. A playground is on the west of the cafe.",
    ):
        planet.locate(text)
    weighs, bound = np.array(seen).T
    assert len(weighs) > len(shards_of(planet).sources)
    assert (weighs <= bound).all()
