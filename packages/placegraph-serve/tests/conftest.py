from serve_world import *  # noqa: F403  # fixtures
