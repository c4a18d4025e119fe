from __future__ import annotations

import numpy as np

from placegraph_lab.tables.named.scene_sentences import (
    bag,
    hits,
    office,
    part_of,
    read_texts,
    reader,
)
from placegraph_lab.tables.named.scene_sentences import report_people as report


def test_first_places_are_counted():
    room = office()
    own = [part_of(room, np.array([i])) for i in (0, room.graph.labels.index("plant"))]
    names = [f"{i}/room" for i in range(2)]
    texts = [type(read_texts()[0])("1/room", "lots of plants")]
    found = hits(
        texts, names, {"ours": reader(own), "bag": bag(own)}, np.random.default_rng(0),
        draws=2, alike=True,
    )  # fmt: skip
    assert found["ours"] == found["bag"] == [1.0]
    row = {"half": "test", "others": "any", "texts": 1, "rooms": 2, "unread": 0.0}
    share = {"mean": 1.0, "low": 1.0, "high": 1.0}
    assert "1.00 (1.00 to 1.00)" in report([row | {"first": {"bag": share}, "ahead": share}])
