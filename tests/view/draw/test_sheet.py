"""Sheets as files."""

from pathlib import Path

import pytest

from placegraph.errors import InputError
from placegraph.view.draw.sheet import Sheet


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full: a disk without room")
def test_a_full_disk_is_told_with_the_name_of_the_file():
    with pytest.raises(InputError, match="/dev/full"):
        Sheet(40, 30).save("/dev/full")
