"""Programs to start from: short, with public names only, and each says something."""

import ast
import runpy
import shutil
import sys
from pathlib import Path

import pytest

import placegraph as pg

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.py"))
LINES = 40
SAYS = {  # what each has found out
    "01_sentence_to_place": "OK:",
    "02_dialogue": "OK:",
    "03_walk": "now at",
    "04_build_from_glb": "standing on floor",
    "05_build_from_rgbd": "frames fused",
    "06_localize": "OK:",
    "07_tracker_loop": " s  ",
    "08_library": "OK altbau",
    "09_change": "moved armchair",
    "10_own_encoder": "OK:",
    "11_world": "OK: Bücherhalle",
}


def test_all_are_listed():
    assert [path.stem for path in EXAMPLES] == list(SAYS)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_it_is_short_and_asks_for_public_names_alone(path):
    text = path.read_text("utf-8")
    assert len(text.splitlines()) <= LINES
    tree = ast.parse(text)
    assert ast.get_docstring(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names if alias.name.startswith("placegraph")]
            assert set(names) <= {"placegraph"}
        elif isinstance(node, ast.ImportFrom):
            assert not node.module.startswith("placegraph")
        elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "pg":
            assert node.attr in pg.__all__


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_it_runs(path, demo_world, tmp_path, monkeypatch, capsys):
    world = tmp_path / "world"
    shutil.copytree(demo_world, world)
    monkeypatch.setattr(sys, "argv", [path.name, str(world)])
    runpy.run_path(str(path), run_name="__main__")
    assert SAYS[path.stem] in capsys.readouterr().out
