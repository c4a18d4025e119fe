"""What is shipped is what the sources hold: no file is missing from wheel and sdist, and none too many."""

import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "placegraph"


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    pytest.importorskip("hatchling", reason="hatchling is not installed (extra dev)")
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)  # noqa: S603  # our own
    return folder


@pytest.fixture(scope="module")
def sources():
    """Files of the package below src, that are not made by running it."""
    made = {"__pycache__"}
    files = (f.relative_to(SOURCE.parent) for f in SOURCE.rglob("*") if f.is_file())
    return {str(f) for f in files if made.isdisjoint(f.parts)}


def test_the_wheel_holds_every_source_and_no_more(built, sources):
    [wheel] = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        home = next(n for n in names if n.endswith("/METADATA")).removesuffix("METADATA")
        told = archive.read(f"{home}METADATA").decode()
    assert {n for n in names if not n.startswith(home)} == sources
    assert {f"{home}licenses/LICENSE", f"{home}licenses/NOTICE"} <= names
    assert "License-Expression: Apache-2.0" in told
    assert "Description-Content-Type: text/markdown" in told


def test_the_sdist_builds_the_same(built, sources):
    [sdist] = built.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {n.partition("/")[2] for n in archive.getnames()}
    assert {n.removeprefix("src/") for n in names if n.startswith("src/")} == sources
    assert {"pyproject.toml", "README.md", "LICENSE", "NOTICE", "PKG-INFO"} <= names
