import numpy as np
import pytest

from placegraph_lab.tables.named.world_locate import ROWS, ask, quarter, report


@pytest.mark.all
def test_a_house_is_where_its_address_is_and_found_by_it(tmp_path):
    world, visits = quarter(2, tmp_path, seed=1)
    city = world.cities["quarter"]
    assert {n for n in city.objects.names if n[0].isdigit()} == {"1 Ahornweg", "2 Ahornweg"}
    anchor = world.scenes["house1"].anchors[0]
    middle = anchor.to_earth(world.scenes["house1"].bounds.mean(axis=0))[:2]
    row = next(i for i in range(len(city.objects)) if city.objects.name(i) == "2 Ahornweg")
    assert np.linalg.norm(city.plane.to_plane(middle) - city.objects.center[row]) < 1.0
    asked = [ask(world, v, row, 0) for v in visits for row in ROWS if "frames" not in row]
    assert all(a["building"] for a in asked)
    assert not any(a["pose"] or a["false_ok"] for a in asked)
    told = report([{**a, "row": row} for row in ROWS for a in asked])
    assert told.count("100%") >= len(ROWS)
