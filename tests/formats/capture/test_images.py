"""Images as they are stored, or as a telephone shows them."""

import numpy as np
import pytest
from PIL import Image

from placegraph.errors import InputError
from placegraph.formats.capture.images import read_rgb


@pytest.fixture
def photo(tmp_path):
    """File of 6 x 4 pixels, red at its left, that EXIF says to show turned clockwise."""
    colours = np.zeros((4, 6, 3), np.uint8)
    colours[:, 0, 0] = 255
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(colours).save(tmp_path / "a.png", exif=exif)
    return tmp_path / "a.png"


def test_intrinsics_say_whether_an_image_is_turned(photo):
    stored = read_rgb(photo, (6, 4))
    assert stored[:, 0, 0].min() == 255
    shown = read_rgb(photo, (4, 6))
    assert shown[0, :, 0].min() == 255
    np.testing.assert_array_equal(np.rot90(stored, -1), shown)


def test_without_a_word_of_it_it_is_not_turned(tmp_path):
    Image.new("RGB", (6, 4)).save(tmp_path / "b.png")
    with pytest.raises(InputError, match="6 x 4 pixels, but its camera says 4 x 6"):
        read_rgb(tmp_path / "b.png", (4, 6))
