"""Rooms, walks and pictures of the core's own tests; PyTorch on one thread."""

import pytest
import torch
from tests.indoor.conftest import *  # noqa: F403  # fixtures
from tests.indoor.encode.conftest import *  # noqa: F403
from tests.indoor.refine.conftest import *  # noqa: F403
from tests.indoor.refine.matching.conftest import *  # noqa: F403


@pytest.fixture(scope="session", autouse=True)
def one_torch_thread():
    """So small are the networks of tests."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
