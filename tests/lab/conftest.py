"""Fixtures of the library's own tests that the lab's trainings need as well."""

import importlib.util
from pathlib import Path

TESTS = Path(__file__).parents[1]


def _of(path):
    spec = importlib.util.spec_from_file_location(f"fixtures_{path.parent.name}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


_indoor = _of(TESTS / "indoor/conftest.py")
room_world, room, walk, truth = _indoor.room_world, _indoor.room, _indoor.walk, _indoor.truth
survey = _of(TESTS / "indoor/encode/scenegraphloc/conftest.py").survey
