"""Fixtures of worlds in shards."""

from tests.world.conftest import *  # noqa: F403  # fixtures
