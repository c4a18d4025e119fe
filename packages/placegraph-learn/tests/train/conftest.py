"""Fixtures of SceneGraphLoc's own tests."""

import importlib.util
from pathlib import Path

from tests.indoor.conftest import *  # noqa: F403  # fixtures

_FILE = Path(__file__).parents[1] / "scenegraphloc/conftest.py"
_spec = importlib.util.spec_from_file_location("fixtures_scenegraphloc", _FILE)
_module = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_module)
survey = _module.survey
