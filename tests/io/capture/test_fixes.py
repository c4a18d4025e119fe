"""GPS fixes: of a table beside the frames, and of EXIF as cameras write it."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from placegraph.errors import InputError, PlacegraphError
from placegraph.io.capture.capture import open_capture
from placegraph.io.capture.fixes import Fix, parse_exif, read_fixes

GPS = {1: "S", 2: (43.0, 30.0, 36.0), 3: "W", 4: (7.0, 15.0, 0.0)}


@pytest.fixture
def folder(tmp_path):
    """Capture of four frames, one a second, of which two have a fix in their EXIF."""
    (tmp_path / "rgb").mkdir()
    for i, gps in enumerate((GPS | {5: b"\x02", 6: 61.5, 31: 4.0}, None, {**GPS, 1: "N"}, {})):
        exif = Image.Exif()
        if gps is not None:
            exif.get_ifd(0x8825).update(gps)
        Image.new("RGB", (32, 24)).save(tmp_path / "rgb" / f"{i}.jpg", exif=exif.tobytes())
    (tmp_path / "camera.json").write_text(
        '{"width": 32, "height": 24, "fx": 30, "fy": 30, "cx": 16, "cy": 12}'
    )
    rows = [f"{100 + i} {i} 0 0 0.5 -0.5 0.5 -0.5" for i in range(4)]
    (tmp_path / "odometry.tum").write_text("\n".join(rows))
    return tmp_path


def test_fixes_come_from_exif(folder):
    fixes = read_fixes(open_capture(folder))
    assert list(fixes) == [0, 2]
    assert fixes[0] == pytest.approx((-7.25, -43.51, 61.5, 4.0))
    assert fixes[2][:2] == pytest.approx((-7.25, 43.51))
    assert math.isnan(fixes[2].height)


def test_a_table_goes_before_exif(folder):
    (folder / "fixes.txt").write_text(
        "# stamp longitude latitude height accuracy\n99.7 7.1 43.5 50 3\n102.2 7.2 43.6 nan nan\n200 7 43 0 1"
    )
    fixes = read_fixes(open_capture(folder))
    assert list(fixes) == [0, 2]  # the third belongs to no frame
    assert fixes[0] == Fix(7.1, 43.5, 50.0, 3.0)
    assert np.isnan(fixes[2][2:]).all()


@pytest.mark.parametrize(
    ("row", "named"),
    [
        ("100 43 170 0 1", "line 1: longitude must be"), ("100 nan 43 0 1", "longitude is nan"),
        ("100 7 43 0 0", "accuracy above 0"), ("100 7 43", "3 columns are given, expected 5"),
    ],
)  # fmt: skip
def test_bad_tables_are_named(folder, row, named):
    (folder / "fixes.txt").write_text(row)
    with pytest.raises(InputError, match=named):
        read_fixes(open_capture(folder))


@pytest.mark.parametrize(
    "gps",
    [
        {**GPS, 2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)}, {**GPS, 2: (float("nan"), 0.0, 0.0)},
        {**GPS, 4: ("x", "y")}, {**GPS, 2: (99.0, 0.0, 0.0)}, {1: "N"},
    ],
)  # fmt: skip
def test_a_fix_that_is_none_is_none(gps):
    exif = Image.Exif()
    exif.get_ifd(0x8825).update(gps)
    assert parse_exif(exif) is None


@pytest.mark.parametrize(("above", "height"), [(b"\x02", 61.5), (3, -61.5), (b"\x00", None)])
def test_heights_above_the_sea_are_not_taken_for_ellipsoidal_ones(above, height):
    exif = Image.Exif()
    exif.get_ifd(0x8825).update(GPS | {5: above, 6: 61.5})
    fix = parse_exif(exif)
    assert fix.height == height if height else math.isnan(fix.height)


@given(st.binary(max_size=200))
def test_any_exif_is_a_fix_or_none(data):
    exif = Image.Exif()
    try:
        exif.load(b"Exif\0\0" + data)
    except Exception:  # noqa: BLE001 - Pillow's own
        return
    try:
        parse_exif(exif)
    except PlacegraphError:
        raise AssertionError from None
