"""Sentences and walks, and what cities answer."""

import io
import json
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

import numpy as np
from golden_answers import city_estimate, fingerprint, read

import placegraph as pg
from placegraph import cli

QUESTIONS = read(Path(__file__).with_name("sentences.json"))
WALKS = {
    "squares": [
        ("tell", "I am on a square. A fountain is north of me and a café is to my east."),
        ("tell", "I walked about 100 metres south. There is a library to my east."),
    ],
    "measured": [
        ("tell", "I am next to a bench."),
        ("move", 120.0, 0.0),
        ("tell", "A tram stop is south of me."),
        ("walk", 60.0, 3.1),
        ("tell", "I am on Lange Straße."),
    ],
    "told": [
        ("tell", "I am at a tram stop."),
        ("tell", "I went 60 metres north. Then I turned right and walked 120 m, and I see a bank."),
        ("tell", "I walked along Speicherweg to the museum."),
        ("tell", "I drove 12 km north."),
    ],
}


def digest(city, every=1):
    """What a city map holds: its graphs, cell by cell."""
    ids = list(city.cells)
    graphs = [city.graph(c) for c in ids[::every]]
    told = {"cells": fingerprint(ids), "objects": len(city.objects), "left_out": city.left_out}
    for column in ("ids", "labels", "names", "positions"):
        told[column] = fingerprint(np.concatenate([getattr(g, column) for g in graphs]))
    relations = np.concatenate([g.relations for g in graphs])
    # points on the very edge of an area are inside or not as the compiler fuses multiplications
    inside = relations == "inside"
    for column in ("sources", "targets", "relations"):
        told[column] = fingerprint(np.concatenate([getattr(g, column) for g in graphs])[~inside])
    return told | {"inside": {"about": float(inside.mean())}}


def located(city, question):
    """Answer to one sentence, and its evidence."""
    told = city_estimate(city.locate(**question))
    if question.get("matcher") == "transformer":
        # where two of its cells are about one place hangs on how many threads add up
        del told["modes"][1:], told["modes"][0]["p"]
    return told


def dialogue(city, text, choose):
    """Answers until the place is clear; `choose` says which of the options is the answer."""
    answers, told = [], []
    for _ in range(4):
        estimate = city.locate(text, answers=answers)
        question = estimate.next_question(city)
        told.append(city_estimate(estimate, 2))
        if question is None:
            break
        told.append({"asks": question.text, "options": question.options, "gain": question.gain})
        answers.append(question.answer(question.options[choose % len(question.options)]))
    return told


def walk(city, steps, **start):
    """Answers along a walk."""
    tracker, told = city.track(**start), []
    for how, *what in steps:
        told.append(city_estimate(getattr(tracker, how)(*what), 2))
    return told


def command(*arguments, stdin=""):
    """What a command prints as JSON; what depends on the clock or the folder left out."""
    out = io.StringIO()
    argv = ["placegraph", *map(str, arguments)]
    with patch.object(sys, "argv", argv), patch.object(sys, "stdin", io.StringIO(stdin)):
        try:
            with redirect_stdout(out), redirect_stderr(io.StringIO()):
                cli.main()
        except SystemExit as end:
            assert not end.code, argv  # noqa: PT017
    return json.loads(out.getvalue())


def town(worlds):
    """The drawn town: every way to ask."""
    city, file = worlds.city("town")
    yield "map", digest(city) | {"kB": file.stat().st_size / 1e3}
    yield "network", fingerprint(city.embeddings, "about")
    for i, question in enumerate(QUESTIONS["town"]):
        yield f"{i}", located(city, question)
    for name, steps in WALKS.items():
        yield f"walk {name}", walk(city, steps)
    yield "walk near", walk(city, WALKS["told"], near=(9.9937, 53.5511), radius=400.0, heading=1.0)
    for i, text in enumerate(("I am next to a bench.", QUESTIONS["town"][1]["text"])):
        for choose in (0, 1):
            yield f"dialogue {i} {choose}", dialogue(city, text, choose)
    asked = ("city", "locate", file, "I am at a tram stop.", "--ask", "--json")
    told = command(*asked, stdin="n\ny\nn\n")
    yield "command", {"status": told["status"], "cells": [m["cell"] for m in told["modes"]]}


def cities(worlds):
    """Real extracts: Monaco and Toronto."""
    for name in ("monaco", "toronto"):
        city, file = worlds.city(name)
        yield f"{name} map", digest(city, 7) | {"kB": file.stat().st_size / 1e3}
        for i, question in enumerate(QUESTIONS[name]):
            yield f"{name} {i}", located(city, question)
    monaco = worlds.city("monaco")[0]
    yield "monaco dialogue", dialogue(monaco, "I am next to a bench.", 0)
    steps = [("tell", QUESTIONS["monaco"][i]["text"]) for i in (7, 9)]
    yield "monaco walk", walk(monaco, [steps[0], ("move", -80.0, 60.0), steps[1]])


def people(worlds):
    """Texts that people wrote: what is read, and where in Manhattan the place is."""
    for name, every in (("pittsburgh", 10), ("manhattan", 3)):
        lines = (worlds.data / f"text/rvs_{name}.jsonl").read_text(encoding="utf-8").splitlines()
        for i in range(0, len(lines), every):
            said = pg.describe(json.loads(lines[i])["content"]).to_dict()
            yield f"read {name} {i}", {k: fingerprint(repr(v)) for k, v in sorted(said.items())}
        if name == "manhattan":
            city, file = worlds.city(name)
            yield "map", digest(city, 31) | {"kB": file.stat().st_size / 1e3}
            for i in range(0, len(lines), 4):
                told = json.loads(lines[i])
                latitude, longitude = told["rvs_start_point"]
                where = {"listener": (longitude, latitude), "near": (longitude, latitude)}
                estimate = city.locate(told["content"], **where, radius=1500.0)
                yield f"{i}", city_estimate(estimate, 2)


GROUPS = {"town": town, "cities": cities, "people": people}
