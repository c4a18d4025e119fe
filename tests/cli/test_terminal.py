"""What is printed steers no terminal, whatever names of maps hold."""

import json
import sys

import click
import pytest

from placegraph.cli.common import (
    bare,
    console,
    echo_json,
    evidence_cells,
    guard_streams,
    harmless,
    show_facts,
    table,
)
from placegraph.core.estimate import Evidence

NAMES = (
    "Caf\x1b[31mé",
    "\x1b]0;owned\x07",
    "\x9b2J",
    "Bäcker\u202e\u2066",
    "a\rb",
    "\u2028",
    "\x7f",
    "\udcff.glb",
)


@pytest.mark.parametrize("name", NAMES)
def test_names_are_shown_and_steer_nothing(name, capsys):
    rows = table("name")
    rows.add_row(name)
    with guard_streams():
        click.echo(name)
        click.echo(f"{name} is no map.", err=True)
        sys.stderr.write(name)
        console().print(name)
        console().print(rows)
        show_facts({"source": name})
        echo_json({"name": name})
    written = "".join(capsys.readouterr())
    assert harmless(written) == written
    assert written.count(harmless(name)) >= 4  # click drops colours, JSON has short escapes
    assert json.loads(f'"{harmless(name)}"') == name


def test_other_text_stays_and_streams_come_back(capsys):
    before = sys.stdout, sys.stderr
    text = "Straße 7\t½ 東京 👩\u200d🚒 ښار\n"
    with guard_streams():
        assert bare(sys.stdout) is before[0]
        sys.stdout.writelines([text, text])
        with pytest.raises(TypeError):
            sys.stdout.write(b"bytes")
    assert (sys.stdout, sys.stderr) == before
    assert capsys.readouterr().out == text + text


@pytest.mark.parametrize(
    ("verdict", "weight", "sign", "ratio"),
    [
        ("for", 9.2, "+", "+9.2"), ("against", -1.1, "-", "-1.1"), ("against", 9.2, "-", ""),
        ("silent", 0.1, " ", "+0.1"),
    ],
)  # fmt: skip
def test_evidence_against_a_place_shows_no_ratio_that_speaks_for_it(verdict, weight, sign, ratio):
    assert evidence_cells(Evidence("it", verdict, weight)) == (sign, "it", ratio)
