"""`placegraph city track`: a sentence a line, an estimate a line."""

import json

import pytest
from PIL import Image

from placegraph_lab.worlds.town.town import Town

LINES = "I am on Speicherweg. The museum is south of me.\n\nI walked 60 m east.\nThe bank is north of me.\n"


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    from placegraph.outdoor.city import build_city

    folder = tmp_path_factory.mktemp("track")
    build_city(Town.load("hafenstadt").write_osm(folder / "town.osm"), folder / "town.city")
    return folder / "town.city"


def test_a_line_an_estimate(run, city):
    result = run("city", "track", city, stdin=LINES)
    assert (result.code, result.err) == (0, "")
    lines = result.out.splitlines()
    assert len(lines) == 3
    assert [line.split()[0] for line in lines][::2] == ["OK", "OK"]
    assert all("%" in line and "±" in line for line in lines)


def test_json_lines(run, city):
    result = run("city", "track", city, "--json", "--top", 2, stdin=LINES + "quit\nA bench.\n")
    told = [json.loads(line) for line in result.out.splitlines()]
    assert [t["said"] for t in told] == [line for line in LINES.splitlines() if line]
    assert all(len(t["modes"]) <= 2 for t in told)
    assert told[-1]["status"] == "OK"
    assert told[-1]["modes"][0]["probability"] > 0.9
    assert 0.0 <= told[-1]["elsewhere"] < 0.1


def test_reset_and_what_is_not_understood(run, city):
    result = run("city", "track", city, stdin="I am next to a bench.\nreset\nzzz\n")
    first, reset, nothing = result.out.splitlines()
    assert first.startswith("AMBIGUOUS")
    assert reset.startswith("LOST: Nothing has been said yet")
    assert nothing.startswith("LOST: Nothing of what was said last could be understood.")


def test_near_and_pictures(run, city, tmp_path):
    longitude, latitude = Town.load("hafenstadt").lonlat(30, 59)
    text = "I am standing on a square. There is a fountain north of me and a café to my east.\n"
    apart = run("city", "track", city, stdin=text)
    page, picture = tmp_path / "a.html", tmp_path / "a.png"
    near = run("city", "track", city, "--near", f"{longitude},{latitude}", "--radius", 60,
               "--html", page, "--png", picture, stdin=text)  # fmt: skip
    assert apart.out.startswith("AMBIGUOUS")
    assert near.out.startswith("OK")
    assert 'getContext("2d")' in page.read_text("utf-8")
    with Image.open(picture) as drawn:
        assert drawn.size == (1200, 900)


@pytest.mark.parametrize(
    ("arguments", "stdin", "code", "word"),
    [(["--near", "here"], "", 7, "--near"), (["--radius", "0", "--near", "1,2"], "", 7, "radius"),
     (["--top", "0"], "", 7, "top"), ([], "A bench\0.\n", 6, "character")],
)  # fmt: skip
def test_what_is_refused(run, city, arguments, stdin, code, word):
    result = run("city", "track", city, *arguments, stdin=stdin)
    assert result.code == code
    assert word in result.err
    assert result.out == ""


def test_typed_at_a_terminal(run, city, monkeypatch):
    import io

    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr(io, "StringIO", Terminal)
    result = run("city", "track", city, stdin="\0\nI am next to a bench.\n")
    assert result.code == 0
    assert result.out.startswith("AMBIGUOUS")
    assert result.err.startswith("> ")
    assert "no character of a text" in result.err
