import pytest

from shards_world import *  # noqa: F403  # fixtures


@pytest.fixture(autouse=True)
def no_time_limit(monkeypatch):
    """Let searches end by themselves, however busy the machine is."""
    monkeypatch.setattr("placegraph_scale.shards.search.BUDGET", 1e6)
