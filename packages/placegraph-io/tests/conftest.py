from tests.io.conftest import *  # noqa: F403  # fixtures
