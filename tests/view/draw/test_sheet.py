"""Sheets as files."""

from pathlib import Path

import pytest
from PIL import Image

from placegraph.errors import InputError, OptionError
from placegraph.view.draw.canvas import LONGEST, Face
from placegraph.view.draw.painter import Sheet, write_image


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full: a disk without room")
def test_a_full_disk_is_told_with_the_name_of_the_file():
    with pytest.raises(InputError, match="/dev/full"):
        Sheet(40, 30).save("/dev/full")


@pytest.mark.parametrize(("name", "form"), [("plan.JPG", "PNG"), ("plan.png", "GIF")])
def test_the_ending_of_another_kind_of_picture_is_refused(name, form, tmp_path):
    with pytest.raises(OptionError, match=f"{name}.* end in .{form.lower()}"):
        write_image(Image.new("RGB", (4, 3)), tmp_path / name, form)
    assert not list(tmp_path.iterdir())
    write_image(Image.new("RGB", (4, 3)), tmp_path / "plan", form)


def test_a_line_is_cut_to_its_room_by_few_looks_at_it(monkeypatch):
    sheet, looks, width = Sheet(400, 30), [], Face.width
    monkeypatch.setattr(Face, "width", lambda *given: looks.append(given) or width(*given))
    short, whole = (
        sheet.text((0, 9), t, 12.0, "ink", room=300.0) for t in ("word " * 6, "word " * 9999)
    )
    assert short < 280.0 < whole <= 300.0
    assert len(looks) < 40


def test_of_a_name_without_end_so_much_is_drawn_as_a_picture_has_room_for():
    face = Face("")
    assert face.drawable("a" * 100_000) == "a" * LONGEST
    assert face.width("ä" * 100_000, 12.0) == face.width("ä" * LONGEST, 12.0)
