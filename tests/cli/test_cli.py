"""The command line: exit codes, one sentence on stderr, answers and nothing else on stdout."""

import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import click
import pytest
from PIL import Image
from tests.cli.failing import fails

from placegraph import __version__, open_map
from placegraph.cli import APP
from placegraph.core.mapfile import map_writer

LINES = "I am on Speicherweg. The museum is south of me.\n\nI walked 60 m east.\nThe bank is north of me.\n"
CLEAR = "I am on Speicherweg. The museum is south of me."
SQUARES = "I am standing on a square. There is a fountain north of me and a café to my east."
IMPOSSIBLE = "A lighthouse is north of me and a zoo is to the south."
HELP = {
    "scene localize": ("--frames", "--near", "--png", "--tum", "--no-refine", "--overlay", "AMBIGUOUS",
                       "Example:"),
    "scene refine": ("--pose", "--estimate", "--matcher", "--overlay", "AMBIGUOUS", "Example:"),
    "scene render": ("--pose", "--tum", "--estimate", "--capture", "overlay.png", "Example:"),
    "capture init": ("--axes", "--depth-unit", "world-to-camera", "Example:"),
    "scene export": ("placegraph scene export house.scene",),
    "scene view": ("placegraph scene view house.scene",),
    "locate": ("placegraph locate town/",),
    "library build": ("[default: labels and appearance]",),
}  # fmt: skip
"""What some helps teach, beside the commands of groups."""


def test_version(run):
    result = run("--version")
    assert (result.code, result.out.strip()) == (0, __version__)


def commands_of(group, words=()):
    """Words of a command and of every one below, with the names of those right below."""
    names = group.list_commands(None) if isinstance(group, click.Group) else []
    yield words, names
    for name in names:
        yield from commands_of(group.get_command(None, name), (*words, name))


def test_every_command_has_help(run):
    for words, names in commands_of(APP):
        result = run(*words, "--help")
        assert (result.code, result.err) == (0, ""), words
        assert result.out.startswith(f"Usage: {' '.join(['placegraph', *words])} "), words
        for word in (*HELP.get(" ".join(words), ()), *names):
            assert word in " ".join(result.out.split()), words


@pytest.mark.parametrize(
    "arguments",
    ["", "city", "nonsense", "city nonsense", "city build", "city build a.osm", "city locate",
     "city locate a.city", "city info", "city build a.osm -o b --cell-size wide",
     "city locate a.city bench --top many", "city info a.city --nonsense",
     "scene", "scene build", "scene build a.glb", "scene info", "scene localize a.scene",
     "scene localize a.scene walk --seed many", "scene encode a.scene -o b.scene"],
)  # fmt: skip
def test_mistyped_commands(arguments, run):
    result = run(*arguments.split())
    assert (result.code, result.out) == (2, "")
    assert "Usage: " in result.err


def test_the_installed_script_and_the_module(city):
    def call(command, *arguments):
        command = [*command, *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603

    script = [Path(sys.executable).with_name("placegraph")]
    found = call(script, "city", "locate", city, CLEAR, "--json")
    assert (found.returncode, json.loads(found.stdout)["status"], found.stderr) == (0, "OK", "")
    module = [sys.executable, "-m", "placegraph"]
    assert call(module, "--version").stdout.strip() == __version__
    missing = call(script, "city", "info", "missing.city")
    assert (missing.returncode, missing.stdout) == (3, "")
    assert "Traceback" not in missing.stderr


def test_build(run, osm, tmp_path):
    out = tmp_path / "a.city"
    result = run("city", "build", osm, "-o", out)
    assert result.code == 0
    assert result.out.startswith(f"{out}: 222 objects in 158 cells")
    assert "reading" not in result.out, "progress is for stderr"
    result = run("city", "build", osm, "-o", out, "--json")
    assert result.err == ""
    told = result.json
    assert told["bytes"] == out.stat().st_size
    assert (told["objects"], told["cells"], told["left_out"]) == (222, 158, {})
    result = run("city", "build", osm, "-o", out, "--quiet")
    assert (result.code, result.out, result.err) == (0, "", "")


@pytest.mark.parametrize("option", [(), ("--no-index",)])
def test_build_of_a_large_map_with_and_without_its_index(run, osm, tmp_path, monkeypatch, option):
    monkeypatch.setattr("placegraph.outdoor.map.city.WORTH", 100)
    out = tmp_path / "a.city"
    assert run("city", "build", osm, "-o", out, *option, "--quiet").code == 0
    city = open_map(out)
    assert (city.index is None) == bool(option)
    assert city.locate("A bench is north of me.").modes


def test_no_index_is_not_of_an_extract_that_becomes_a_world(run, osm, tmp_path, monkeypatch):
    monkeypatch.setattr("placegraph.io.osm.urls.SMALL", 100)
    result = run("city", "build", osm, "-o", tmp_path / "a", "--no-index")
    assert result.code == 7
    assert "--no-index applies only to a single map" in result.err
    assert not (tmp_path / "a").exists()


def test_build_says_what_was_left_out(run, tmp_path):
    path = tmp_path / "clipped.osm"
    path.write_text(
        '<osm version="0.6"><node id="1" lat="50" lon="10"><tag k="shop" v="bakery"/></node>'
        '<way id="1"><nd ref="7"/><nd ref="8"/><tag k="highway" v="path"/></way></osm>'
    )
    result = run("city", "build", path, "-o", tmp_path / "a.city")
    assert result.code == 0
    assert "Left out: 1 ways without positions." in result.out


def test_build_options(run, osm, tmp_path):
    out = tmp_path / "a.city"
    options = ("--cell-size", "40", "--stride", "20", "--edge-distance", "30")
    assert run("city", "build", osm, "-o", out, *options, "--json").json["cell_size"] == 40.0
    fails(run("city", "build", osm, "-o", out, "--cell-size", "0"), 7, "cell_size")
    fails(run("city", "build", osm, "-o", out, "--stride", "nan"), 7, "stride")
    fails(run("city", "build", osm, "-o", out, "--vocabulary", tmp_path / "no"), 3, "no")


def test_build_refuses(run, osm, city, tmp_path):
    out = tmp_path / "a.city"
    fails(run("city", "build", tmp_path / "no.osm", "-o", out), 3, "no.osm", "does not exist")
    fails(run("city", "build", city, "-o", out), 3, "town.city", "unknown ending")
    fails(run("city", "build", osm, "-o", osm), 7, "town.osm")
    fails(run("city", "build", osm, "-o", tmp_path / "no" / "a.city"), 4, "a.city")
    fails(run("city", "build", osm, "-o", tmp_path), 4, tmp_path.name)
    (tmp_path / "empty.osm.pbf").touch()
    fails(run("city", "build", tmp_path / "empty.osm.pbf", "-o", out), 3, "empty.osm.pbf")
    (tmp_path / "bad.osm.bz2").write_bytes(b"BZh9garbage")
    fails(run("city", "build", tmp_path / "bad.osm.bz2", "-o", out), 3, "bad.osm.bz2")
    with map_writer(out):
        fails(run("city", "build", osm, "-o", out), 5, "a.city")
    assert not out.exists()


def test_locate(run, city):
    result = run("city", "locate", city, CLEAR)
    assert (result.code, result.err) == (0, "")
    assert result.out.startswith("OK: ")
    for word in ("Speichermuseum", "cell c", "%"):
        assert word in result.out
    result = run("city", "locate", city, CLEAR, "--json", "--top", "3")
    assert result.err == ""
    told = result.json
    assert told["status"] == "OK"
    assert told["question"] is None
    best = told["modes"][0]
    assert best["latitude"] == pytest.approx(53.5496, abs=3e-4)
    assert best["longitude"] == pytest.approx(9.9918, abs=3e-4)
    assert {e["verdict"] for e in best["evidence"]} == {"for"}
    assert best["evidence"][0]["objects"][0]["id"].startswith("way/")
    assert told["understood"]["text"] == CLEAR


def test_ambiguous_and_impossible(run, city):
    told = run("city", "locate", city, SQUARES, "--json").json
    assert told["status"] == "AMBIGUOUS"
    assert told["question"].endswith("?")
    assert told["question"] in run("city", "locate", city, SQUARES).out
    lost = run("city", "locate", city, IMPOSSIBLE)
    assert (lost.code, lost.err) == (0, ""), "not to be found is no error"
    assert lost.out.startswith("LOST: ")
    assert run("city", "locate", city, IMPOSSIBLE, "--json").json["modes"] == []


def test_text_from_standard_input(run, city):
    assert run("city", "locate", city, "-", "--json", stdin=CLEAR + "\n").json["status"] == "OK"
    fails(run("city", "locate", city, "-", stdin=""), 6, "empty")
    fails(run("city", "locate", city, "-", stdin="x" * 200_000), 6, "characters")


def test_bytes_that_are_no_text(city):
    done = subprocess.run(  # noqa: S603  # our own interpreter and code
        [sys.executable, "-m", "placegraph.cli", "city", "locate", city, "-"],
        input=b"\xff\xfe\x00bench",
        capture_output=True,
        env=os.environ | {"PYTHONUTF8": "1"},
        check=False,
    )
    assert done.returncode == 6
    assert done.stdout == b""
    assert b"Traceback" not in done.stderr


def test_locate_options(run, city):
    near = run(
        "city", "locate", city, SQUARES, "--json", "--near", "9.9928,53.5524", "--radius", "50"
    )
    assert near.json["status"] == "OK"
    away = run("city", "locate", city, SQUARES, "--json", "--near", "-79.39,43.66")
    assert away.json["status"] == "LOST"
    left = "I am on Gartenweg, and a bookshop is left of me."
    assert run("city", "locate", city, left, "--json", "--heading-deg", "0").json["status"] == "OK"
    for wind, latitude in (("north", 53.5524), ("south", 53.5502)):
        text = f"I am next to a fountain on a square, and I am {wind} of you."
        told = run("city", "locate", city, text, "--json", "--listener", "9.9941,53.5511").json
        assert told["modes"][0]["latitude"] == pytest.approx(latitude, abs=4e-4)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (("--near", "here"), "--near"), (("--near", "9.99"), "--near"),
        (("--near", "1,2,3"), "--near"), (("--near", "nan,53"), "near"),
        (("--near", "200,53"), "near"), (("--listener", "9.99;53"), "--listener"),
        (("--near", "9.99,53.55", "--radius", "0"), "radius"), (("--top", "0"), "top"),
        (("--near", "9.99,53.55", "--radius", "nan"), "radius"),
        (("--radius", "500"), "--radius applies only to --near"), (("--heading-deg", "nan"), "heading"),
        (("--heading-deg", "inf"), "heading"),
    ],
)  # fmt: skip
def test_bad_options(options, word, run, city):
    fails(run("city", "locate", city, CLEAR, *options), 7, word)


def test_what_is_no_map(run, osm, city, tmp_path):
    for command in (["locate"], ["info"], ["check"]):
        text = ["bench"] if command == ["locate"] else []
        fails(run("city", *command, tmp_path / "no.city", *text), 3, "no.city", "does not exist")
        fails(run("city", *command, osm, *text), 4, "town.osm", "not a placegraph map")
        fails(run("city", *command, tmp_path, *text), 3, tmp_path.name)
        damaged = tmp_path / "damaged.city"
        damaged.write_bytes(city.read_bytes()[:-100])
        fails(run("city", *command, damaged, *text), 4, "damaged.city")


def test_page_and_picture(run, city, tmp_path):
    page, picture = tmp_path / "a.html", tmp_path / "a.png"
    result = run("city", "locate", city, SQUARES, "--html", page, "--png", picture, "--json")
    assert result.json["status"] == "AMBIGUOUS"
    assert 'getContext("2d")' in page.read_text("utf-8")
    with Image.open(picture) as image:
        assert min(image.size) > 100
    fails(run("city", "locate", city, CLEAR, "--html", tmp_path / "no" / "a.html"), 3, "a.html")
    fails(run("city", "locate", city, CLEAR, "--png", tmp_path / "no" / "a.png"), 3, "a.png")


def test_names_and_texts_are_printed_as_they_are(run, tmp_path):
    path = tmp_path / "brackets.osm"
    path.write_text(
        '<osm version="0.6"><node id="1" lat="50" lon="10"><tag k="shop" v="bakery"/>'
        '<tag k="name" v="Kern [/b] [red]:smile:"/></node>'
        '<node id="2" lat="50.0001" lon="10"><tag k="amenity" v="[/x]"/></node></osm>'
    )
    city = tmp_path / "a.city"
    assert run("city", "build", path, "-o", city).code == 0
    result = run("city", "locate", city, "I am next to a bakery [/bold].")
    assert result.code == 0
    assert "Kern [/b] [red]:smile:" in result.out
    info = run("city", "info", city)
    assert info.code == 0
    assert "brackets.osm" in info.out


@pytest.mark.parametrize(("preset", "candidates"), [("paper", 1), ("paper", 10), ("published", 10)])
def test_ranks_are_printed_without_a_percentage(run, city, preset, candidates):
    asked = ("city", "locate", city, CLEAR, "--preset", preset, "--candidates", candidates)
    told = run(*asked)
    assert told.code == 0, told.err
    assert told.out.startswith("AMBIGUOUS: The ")
    assert "1. " in told.out
    assert "%" not in told.out
    assert run(*asked, "--json").json["modes"][0]["probability"] < 0.1


def test_a_matcher_of_viewpoints_has_the_network_of_viewpoints_in_every_preset(run, city):
    asked = ("city", "locate", city, CLEAR, "--matcher", "fused", "--json")
    told = run(*asked, "--preset", "paper")
    assert told.code == 0, told.err
    assert told.json["modes"] == run(*asked).json["modes"]


@pytest.mark.parametrize("options", [(), ("--preset", "paper", "--matcher", "relational")])
def test_candidates_that_nothing_counts_are_refused(run, city, options):
    refused = run("city", "locate", city, CLEAR, *options, "--candidates", 5)
    assert (refused.code, refused.out) == (7, "")
    assert "candidates is 5, but relational search with sparse" in refused.err


def test_ask_until_the_place_is_clear(run, city):
    question = run("city", "locate", city, SQUARES, "--json").json["question"]
    assert "Rathausplatz" in question
    answered = "maybe\nRathausplatz\n" + "yes\n" * 5
    result = run("city", "locate", city, SQUARES, "--ask", "--json", stdin=answered)
    assert result.code == 0
    told = result.json
    assert told["status"] == "OK"
    assert told["modes"][0]["latitude"] == pytest.approx(53.5524, abs=3e-4)
    assert question in result.err
    assert "'maybe' is not a valid answer" in result.err
    other = run("city", "locate", city, SQUARES, "--ask", "--json", stdin="Fischmarkt\nyes\n")
    assert other.json["modes"][0]["latitude"] == pytest.approx(53.5500, abs=3e-4)
    none = run("city", "locate", city, SQUARES, "--ask", "--json", stdin="n\n")
    assert none.code == 0
    assert "is not a valid answer" not in none.err
    assert any(s["negated"] for s in none.json["understood"]["statements"])


def test_ask_asks_nothing_where_all_is_clear_and_answers_whoever_goes_away(run, city):
    result = run("city", "locate", city, CLEAR, "--ask", "--json")
    assert (result.json["status"], result.err) == ("OK", "")
    for stdin in ("", "don't know\n"):
        result = run("city", "locate", city, SQUARES, "--ask", "--json", stdin=stdin)
        assert result.code == 0
        assert result.json["status"] == "AMBIGUOUS"


def test_track_prints_an_estimate_a_line(run, city):
    result = run("city", "track", city, stdin=LINES)
    assert (result.code, result.err) == (0, "")
    lines = result.out.splitlines()
    assert len(lines) == 3
    assert [line.split()[0] for line in lines][::2] == ["OK", "OK"]
    assert all("%" in line and "±" in line for line in lines)
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
    assert reset.startswith("LOST: There is no text yet")
    assert nothing.startswith("LOST: The last text could not be understood.")


def test_track_near_with_pictures(run, city, hafenstadt, tmp_path):
    longitude, latitude = hafenstadt.lonlat(30, 59)
    apart = run("city", "track", city, stdin=SQUARES)
    page, picture = tmp_path / "a.html", tmp_path / "a.png"
    near = run("city", "track", city, "--near", f"{longitude},{latitude}", "--radius", 60,
               "--html", page, "--png", picture, stdin=SQUARES)  # fmt: skip
    assert apart.out.startswith("AMBIGUOUS")
    assert near.out.startswith("OK")
    assert 'getContext("2d")' in page.read_text("utf-8")
    with Image.open(picture) as drawn:
        assert drawn.size == (1200, 900)


@pytest.mark.parametrize(
    ("arguments", "stdin", "code", "word"),
    [(["--near", "here"], "", 7, "--near"), (["--radius", "0", "--near", "1,2"], "", 7, "radius"),
     (["--top", "0"], "", 7, "top"), (["--radius", "9"], "", 7, "only to --near"),
     ([], "A bench\0.\n", 6, "character")],
)  # fmt: skip
def test_track_refuses(run, city, arguments, stdin, code, word):
    fails(run("city", "track", city, *arguments, stdin=stdin), code, word)


def test_track_at_a_terminal(run, city, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr(io, "StringIO", Terminal)
    result = run("city", "track", city, stdin="\0\nI am next to a bench.\n")
    assert result.code == 0
    assert result.out.startswith("AMBIGUOUS")
    assert result.err.startswith("> ")
    assert "the control character" in result.err


def test_info(run, city, tmp_path):
    result = run("city", "info", city)
    assert result.code == 0
    assert "222" in result.out
    told = run("city", "info", city, "--json").json
    assert told["bytes"] == city.stat().st_size
    west, south, east, north = told["west_south_east_north_deg"]
    assert west < 9.9937 < east
    assert south < 53.5511 < north
    assert told["source"] == "town.osm"
    assert run("city", "info", city, "--png", tmp_path / "a.png").code == 0
    with Image.open(tmp_path / "a.png") as image:
        assert min(image.size) > 100


def test_check(run, city, tmp_path):
    assert run("city", "check", city).out == f"{city} is sound.\n"
    assert run("city", "check", city, "--json").json == []
    lone = tmp_path / "lone.osm"
    lone.write_text(
        '<osm version="0.6"><node id="1" lat="50" lon="10"><tag k="shop" v="bakery"/></node></osm>'
    )
    run("city", "build", lone, "-o", tmp_path / "lone.city")
    found = run("city", "check", tmp_path / "lone.city", "--json").json
    assert any("No cell" in line for line in found)
    listed = run("city", "check", tmp_path / "lone.city").out
    assert listed.count("\n- ") + 1 == len(found)


def test_fetch_refuses_before_it_asks_the_network(run, tmp_path):
    result = run("city", "fetch", "Vaduz", "-o", tmp_path / "a.txt")
    assert result.code != 0
    assert result.out == ""
    assert "a.txt" in result.err


@pytest.mark.all  # CI runs `make demo`
def test_demo(run, tmp_path):
    result = run("demo", "--out", tmp_path / "new" / "demo")
    assert result.code == 0
    for word in ("OK", "AMBIGUOUS", "LOST", "To be sure"):
        assert word in result.out
    way = result.out.partition("A person describes")[2].partition("\nBuilt ")[0]
    assert [word for word in way.split() if word in ("AMBIGUOUS:", "OK:")] == (
        ["AMBIGUOUS:", "AMBIGUOUS:", "OK:"]
    )
    off = dict(re.findall(r"^ *(coarse|refined) +([\d.]+)", result.out, re.MULTILINE))
    assert float(off["refined"]) < min(float(off["coarse"]), 1.0), "cm, median of all frames"
    assert "OK: altbau fits" in result.out, "the film's flat among five homes"
    made = {p.name for p in (tmp_path / "new" / "demo").iterdir()}
    assert made >= {
        f"{n}.{e}" for n in ("clear", "ambiguous", "impossible") for e in ("html", "png")
    }
    assert made >= {"world", "altbau.scene", "walk.png", "walk.gif", "overlay.png"}
    given = {p.name for p in (tmp_path / "new" / "demo" / "world").iterdir()}
    assert given == {
        *(
            f"{town}.{ending}"
            for town in ("hafenstadt", "marktstadt")
            for ending in ("osm", "city")
        ),
        *("homes.library", "altbau.glb", "altbau.scene", "altbau_twin.scene", "walk", "window"),
        *(f"home{i}.scene" for i in range(1, 5)),
    }
    assert "placegraph scene localize" in result.out.partition("The same with commands:")[2]
    asked = result.out.partition("two flats are identical")[2].partition("Look at")[0]
    assert [word for word in asked.split() if word in ("AMBIGUOUS:", "OK:")] == (
        ["AMBIGUOUS:", "OK:", "AMBIGUOUS:", "OK:", "OK:"]
    )
    world = tmp_path / "new" / "demo" / "world"
    told = run("locate", world, "I am in the dining room of Zum Anker", "--json")
    assert (told.code, told.json["status"]) == (0, "OK")
    assert told.json["modes"][0]["building"] == "Zum Anker"
    (tmp_path / "file").touch()
    fails(run("demo", "--out", tmp_path / "file"), 3, "file")
