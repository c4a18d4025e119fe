"""The public surface: light to import, complete when used."""

import subprocess
import sys

import pytest

import placegraph as pg


@pytest.mark.parametrize("name", pg.__all__)
def test_every_public_name_is_there(name):
    assert getattr(pg, name) is not None
    assert name in dir(pg)


def test_other_names_are_not():
    with pytest.raises(AttributeError, match="has no attribute 'teleport'"):
        pg.teleport  # noqa: B018


def test_import_is_light():
    code = "import sys, placegraph; print(*sys.modules)"
    found = subprocess.run(  # noqa: S603  # our own interpreter and code
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    heavy = {"numpy", "numba", "osmium", "PIL", "lark", "rapidfuzz", "typer", "rich", "networkx"}
    assert not heavy & set(found)
