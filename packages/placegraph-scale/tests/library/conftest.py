"""Rooms."""

from tests.indoor.library.conftest import *  # noqa: F403  # fixtures
