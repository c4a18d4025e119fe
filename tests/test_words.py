"""`tools/check_words.py` finds names that are no standard term."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "tools/check_words.py"


def check(folder, code):
    (folder / "src").mkdir()
    (folder / "src/names.py").write_text(code)
    done = subprocess.run(  # noqa: S603  (our own script)
        [sys.executable, SCRIPT], cwd=folder, capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout


@pytest.mark.parametrize(
    ("code", "line", "name"),
    [
        ("def thinned(view): ...", 1, "thinned"),
        ("async def torn(): ...", 1, "torn"),
        ("class Fused: ...", 1, "Fused"),
        ("class Box:\n    def grown(self): ...", 2, "grown"),
        ("class Box:\n    @classmethod\n    def none(cls): ...", 3, "none"),
    ],
)
def test_bare_participles_and_pronouns_are_found(tmp_path, code, line, name):
    status, out = check(tmp_path, code)
    assert (status, out) == (
        1,
        f"src/names.py:{line}: {name}: bare participle or pronoun; say verb and object, or a noun\n",
    )


@pytest.mark.parametrize(
    "code",
    [
        "def thin_view(view): ...", "def _thinned(view): ...", "def open(path): ...",
        "class FusedSurface: ...", "class Town: ...",
        "class Box:\n    @property\n    def closed(self): ...",
        "class Box:\n    @cached_property\n    def merged(self): ...",
        "def outer():\n    def joined(): ...",
    ],
)  # fmt: skip
def test_verbs_nouns_properties_and_private_names_are_not(tmp_path, code):
    assert check(tmp_path, code) == (0, "words: no finding\n")
