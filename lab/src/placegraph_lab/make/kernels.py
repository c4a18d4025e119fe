# mypy: disable-error-code="attr-defined"
"""List of the kernels that each command compiles (`placegraph.core.warm`), found by running them."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from string import ascii_lowercase
from types import FunctionType
from typing import cast

from numba.core import types

from placegraph.core.jit import Kernel
from placegraph.errors import InputError

HEAD = """\
# The kernels that Python calls: the letters of the commands that need them, and the types of their
# arguments; those that take longest come first, those that share parts with these last. Written by
# `placegraph-lab kernels`; read by `placegraph.core.warm`.
"""
QUERIES = (
    "I'm at a fountain. The Casino de Monte-Carlo is south of me and the Hotel de Paris is to the southwest.",
    "I am between a bank and a school. There is no bus stop here. Two benches are near the church.",
    "The bakery is 50 m north of a bank, and the bank is near a street.",
)
FIRST, LATER = "house/seq00 --frames 0:10", "house/seq02 --frames 10:20"
RUNS = {
    "demo": ["--out demo"],
    "city build": [
        "{data}/osm/monaco_2025.osm.pbf -o m.city",
        "{data}/osm/toronto_downtown_2020.osm.bz2 -o t.city",
        "{data}/osm/vancouver_2015.osm.pbf -o v.city",
    ],
    "city locate": [f"v.city {shlex.quote(text)}" for text in QUERIES],
    "city locate, without an index": [
        *(f"{city}.city {shlex.quote(text)}" for text in QUERIES for city in "mt"),
        f"m.city {shlex.quote(QUERIES[0])} --near 7.4277,43.7394 --radius 300",
        f"m.city {shlex.quote(QUERIES[0])} --matcher relational",
    ],
    "city locate, by the network": [f"m.city {shlex.quote(QUERIES[0])} --matcher transformer"],
    "city check": ["m.city"],
    "city track": ["m.city < walk.txt"],
    "city embed": ["m.city -o m.vectors"],
    "scene build": ["{data}/house/map/house.glb -o h.scene"],
    "scene build, of frames": ["{data}/office -o o.scene --frames 0:186:6"],
    "scene localize": [f"h.scene {{data}}/{FIRST}", "o.scene {data}/office --frames 240:260:4"],
    "scene localize, without depth": [f"h.scene {{data}}/{LATER} --no-depth"],
    "scene localize, with a sentence": [
        f"h.scene {{data}}/{LATER} --description 'I see a fridge. I am facing the window.'"
    ],
    "scene refine": [f"h.scene {{data}}/{LATER} --pose 2.5,1.3,1.7,12"],
    "scene render": [
        "h.scene --out seen --pose 2.5,1.3,1.7,12 --camera {data}/house/seq02/camera.json"
    ],
    "scene check": ["h.scene"],
    "scene diff": ["h.scene {data}/house/seq02 --frames ::6 -o changes.json"],
    "scene update": ["h.scene changes.json -o now.scene"],
    "scene export": ["h.scene h.glb"],
    "scene info": ["h.scene --png plan.png"],
    "library build": ["h.scene o.scene -o p.library"],
    "library search": [f"p.library {{data}}/{LATER}"],
    "library search, by a sentence": ["p.library 'a bedroom with a bed and a wardrobe'"],
    "library localize": [f"p.library {{data}}/{LATER}"],
}
WALK = "A fountain is north of me.\nI walked about 100 metres south. There is a bank to my east.\n"
PROGRAM = """
import contextlib, json, sys
from placegraph.cli import APP
with contextlib.suppress(SystemExit):
    APP.main(sys.argv[2:], prog_name="placegraph", standalone_mode=False)
from placegraph.core.jit import Kernel
from placegraph_lab.make.kernels import spell_call
names, calls = {}, {}
for name, module in list(sys.modules.items()):
    for found in vars(module).values() if name.startswith("placegraph.") else ():
        if isinstance(found, Kernel):
            for types in found.overloads:
                kept = [p for p in found._cache.files(types) if p.exists()]
                size = max((p.stat().st_size for p in kept), default=0)
                calls[spell_call(found, types, names)] = size
json.dump([names, calls], open(sys.argv[1], "w"))
"""


def list_kernels(data: Path, report: Callable[[str], None]) -> str:
    """Return the list, by running all commands on the shared data in folder `data`."""
    names: dict[str, str] = {}
    calls: dict[str, dict[str, int]] = {}
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "walk.txt").write_text(WALK, encoding="utf-8")
        for label, run in [(label, run) for label, runs in RUNS.items() for run in runs]:
            words = [
                *label.partition(",")[0].split(),
                *shlex.split(run.format(data=data.resolve())),
            ]
            tuple_names, found = _called(words, Path(folder))
            _merge(tuple_names, found, names, calls.setdefault(label, {}))
            report(f"{len(found):4} {label}")
    lines = [f"{letter}: {label}" for letter, label in zip(ascii_lowercase, calls, strict=False)]
    lines += [f"{name} = {text}" for text, name in names.items()]
    sizes = {call: size for found in calls.values() for call, size in found.items()}
    for call in sort_calls(sorted(sizes, key=lambda call: (-sizes[call], call))):
        needed = zip(ascii_lowercase, calls.values(), strict=False)
        lines.append(f"{''.join(letter for letter, found in needed if call in found)} {call}")
    return HEAD + "\n".join(lines) + "\n"


def sort_calls(calls: list[str]) -> list[str]:
    """Move calls that share parts with earlier ones to the end."""
    first: list[str] = []
    later: list[str] = []
    used: set[str] = set()
    for call in calls:
        module, name = call.partition("(")[0].rsplit(".", 1)
        parts = _parts_of(getattr(import_module(f"placegraph.{module}"), name).py_func)
        (later if parts & used else first).append(call)
        used |= set() if parts & used else parts
    return first + later


def _parts_of(function: FunctionType) -> set[str]:
    """Return the names of the kernels that a function calls, recursively, and its own."""
    called = [function.__globals__.get(name) for name in function.__code__.co_names]
    kernels = [cast("FunctionType", k.py_func) for k in called if isinstance(k, Kernel)]
    return {f"{function.__module__}.{function.__name__}"}.union(*map(_parts_of, kernels))


def spell_call(kernel: Kernel, args: tuple[types.Type, ...], names: dict[str, str]) -> str:
    """Return a call as `kernels.txt` writes it; `names` collects named tuples by their definition."""
    function = kernel.py_func
    where = f"{function.__module__}.{function.__qualname__}".removeprefix("placegraph.")
    return f"{where}({', '.join(_spell_type(arg, names) for arg in args)})"


def _spell_type(kind: types.Type, names: dict[str, str]) -> str:
    if isinstance(kind, types.Array):
        axes = [":"] * kind.ndim
        if kind.layout != "A":
            axes[-1 if kind.layout == "C" else 0] = "::1"
        text = f"{_spell_type(kind.dtype, names)}[{', '.join(axes)}]"
        return text if kind.mutable else f"readonly({text})"
    if isinstance(kind, types.BaseNamedTuple):
        members = ", ".join(_spell_type(member, names) for member in kind)
        cls = kind.instance_class
        text = f"{cls.__module__}.{cls.__qualname__}({members})".removeprefix("placegraph.")
        same = sum(name.startswith(cls.__name__) for name in names.values())
        return names.setdefault(text, f"{cls.__name__}{same or ''}")
    if isinstance(kind, types.BaseTuple):
        return f"({', '.join(_spell_type(member, names) for member in kind)},)"
    if isinstance(kind, types.Omitted):
        return f"omitted({kind.value!r})"
    return str(kind)


def _called(words: list[str], folder: Path) -> tuple[dict[str, str], dict[str, int]]:
    """Run a command; return names of tuples by definition, and bytes of code by call."""
    given = (folder / words[-1]).read_text("utf-8") if "<" in words else None
    words = words[: words.index("<")] if "<" in words else words
    out = folder / "calls.json"
    done = subprocess.run(  # noqa: S603  # our own
        [sys.executable, "-c", PROGRAM, out, *words],
        cwd=folder, input=given, text=True, capture_output=True, check=False,
    )  # fmt: skip
    if done.returncode:
        raise InputError(f"placegraph {shlex.join(words)} failed: {done.stderr.strip()[-500:]}")
    tuple_names, found = json.loads(out.read_text("utf-8"))
    return tuple_names, found


def _merge(
    tuple_names: dict[str, str],
    new_calls: dict[str, int],
    names: dict[str, str],
    calls: dict[str, int],
) -> None:
    """Merge the calls of one run, whose names of tuples may differ."""
    renamed: dict[str, str] = {}
    for text, name in tuple_names.items():
        plain = name.rstrip("0123456789")
        alike = sum(known.rstrip("0123456789") == plain for known in names.values())
        renamed[name] = names.setdefault(_spell(text, renamed), f"{plain}{alike or ''}")
    for call, size in new_calls.items():
        calls[_spell(call, renamed)] = size


def _spell(text: str, renamed: dict[str, str]) -> str:
    """Replace names of tuples where they stand as words among arguments."""
    head, bracket, rest = text.partition("(")
    return head + bracket + re.sub(r"\b[A-Z]\w*\b", lambda m: renamed.get(m[0], m[0]), rest)
