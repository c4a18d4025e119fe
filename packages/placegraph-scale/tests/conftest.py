from tests.world.conftest import *  # noqa: F403  # fixtures
