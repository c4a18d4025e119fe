from shards_world import *  # noqa: F403  # fixtures
