import pytest

from placegraph_lab.tables.named.scene_changes import WindowChanges, figures, report


def make_row(**columns):
    plain = {
        "sequence": "seq01", "first": 0, "frames": 10, "status": "OK", "changed": True,
        "visible": ("1", "2", "3"), "detected": ("1", "2"), "moves": 1, "moves_found": 1, "removed": 1,
        "removed_found": 1, "errors": ((0.02, 1.0),), "right": (0.9, 0.8), "wrong": (0.3,),
        "new_right": 1, "new_wrong": 1, "seconds": 2.0,
    }  # fmt: skip
    return WindowChanges(**(plain | columns))


def test_sums_and_rates():
    still = make_row(
        sequence="seq00", changed=False, visible=(), detected=(), moves=0, moves_found=0, removed=0,
        removed_found=0, errors=(), right=(), wrong=(0.6,), new_right=0, new_wrong=0,
    )  # fmt: skip
    f = figures([make_row(), still])
    assert f["recall"] == pytest.approx(2 / 3)
    assert f["precision"] == pytest.approx(2 / 4)
    assert (f["still_windows"], f["still_false"]) == (1, 1)
    assert (f["median_m"], f["median_deg"]) == (0.02, 1.0)
    assert f["confidence_right"] > f["confidence_wrong"]
    table = report([("10 frames", [make_row(), still])])
    assert ".67 (2 of 3)" in table
    assert ".50 (2 of 4)" in table
    assert "1 in 1" in table
