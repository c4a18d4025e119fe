"""Walks through the room that are long enough to be followed."""

import pytest


@pytest.fixture(scope="package")
def film(room_world, render):
    """36 frames through the room, five a second."""
    return render(room_world, "film", 5, through="1323121", frames=36)


@pytest.fixture(scope="package")
def elsewhere(room_world, render):
    """14 frames on another way through it."""
    return render(room_world, "elsewhere", 6, through="2131", frames=14)
