import copy

import pytest
import torch
from tests.indoor.conftest import render, room, room_world, truth, walk  # noqa: F401  # fixtures
from tests.indoor.encode.conftest import timm  # noqa: F401
from tests.indoor.refine.matching.conftest import picture  # noqa: F401

from placegraph_learn.training import Progress


@pytest.fixture(scope="session", autouse=True)
def one_torch_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


class Notes(Progress):
    """Progress of a training, as it was reported; ends it as Ctrl-C does at `stop`, (epoch, step)."""

    def __init__(self, stop=None):
        self.stop, self.filled, self.prepared, self.steps, self.rows = stop, [], [], [], []

    def report_descriptions(self, *made):
        self.filled.append(made)

    def report_place(self, *prepared):
        self.prepared.append(prepared)

    def step(self, epoch, done, total, losses):
        self.steps.append((epoch, done, total, copy.copy(losses)))
        if (epoch, done) == self.stop:
            raise KeyboardInterrupt

    def epoch(self, row):
        self.rows.append(dict(row))


@pytest.fixture(scope="session")
def make_notes():
    return Notes
