"""Rooms, walks and pictures of the core's own tests."""

from tests.indoor.conftest import *  # noqa: F403  # fixtures
from tests.indoor.encode.conftest import *  # noqa: F403
from tests.indoor.refine.conftest import *  # noqa: F403
from tests.indoor.refine.matching.conftest import *  # noqa: F403
