"""The list of what commands compile holds, and what it lists is compiled before it is called."""

import inspect
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool
from importlib.resources import files
from pathlib import Path

import pytest
from numba.core import types

from placegraph import cli
from placegraph.cli.compiling import Compiling
from placegraph.core import cache, warm
from placegraph.errors import OptionError

CALLS = list(dict.fromkeys(call for calls in warm.commands().values() for call in calls))
SMALL = next(call for call in CALLS if ".code(" in call)


def _name(call):
    return f"placegraph.{call.partition('(')[0]}"


@pytest.fixture(autouse=True)
def _fresh(monkeypatch, tmp_path):
    monkeypatch.setattr(cache, "FOLDERS", cache.CacheFolders())
    cache.FOLDERS.choose(tmp_path / "kept")


@pytest.mark.parametrize("call", CALLS)
def test_calls_are_kernels_and_types_of_today(call):
    kernel, args = warm._found(call), warm._types_of(call, warm._words())
    assert len(args) == len(inspect.signature(kernel.py_func).parameters)
    definitions = (line.split(" = ") for line in warm._lines() if " = " in line)
    names = {text: name for name, text in definitions}
    assert warm.spelled(kernel, args, names) == call


def test_types_are_read_as_they_are_spelled():
    words = warm._words()
    args = (
        types.float64, types.Array(types.float32, 2, "C"), types.Array(types.uint8, 3, "A"),
        types.Array(types.int64, 2, "F"), types.Array(types.int32, 1, "C", readonly=True),
        types.UniTuple(types.int64, 2), types.Tuple((types.boolean, types.float64)),
        words["Surfaces"], types.Omitted(1), types.none,
    )  # fmt: skip
    kernel = warm._found(SMALL)
    assert warm._types_of(warm.spelled(kernel, args, {
        line.split(" = ")[1]: line.split(" = ")[0] for line in warm._lines() if " = " in line
    }), words) == args  # fmt: skip


def test_the_simplest_kind_of_a_command():
    build = warm.commands()["scene build"]
    flood, fused = (
        _name(next(call for call in CALLS if end in call)) for end in (".flood(", ".integrate(")
    )
    assert warm.calls_with(flood, ["scene", "build", "x"]) == build
    assert len(warm.calls_with(fused, ["scene", "build", "x"])) > len(build)
    assert warm.calls_with(fused, ["city", "locate", "x"]) == []


def test_compiled_before_it_is_called():
    told = []
    assert warm.missing([SMALL, SMALL]) == [SMALL]
    bad = SMALL.replace("int32[::1])", "float64)")
    failed = warm.warm([SMALL, bad], told.append)
    assert sorted(told) == sorted([SMALL, bad])
    assert [reason.split(":")[0] for reason in failed] == [bad.split(":")[0]]
    assert warm.missing([SMALL]) == []


def test_the_command_compiles_what_is_missing(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(warm, "commands", lambda: {"scene build": [SMALL]})
    monkeypatch.setattr("sys.argv", ["placegraph", "--compiled", str(tmp_path / "mine"), "warm"])
    for said in ("1 of 1 functions compiled in", "0 of 1 functions compiled in"):
        with pytest.raises(SystemExit) as end:
            cli.main()
        assert not end.value.code
        out = capsys.readouterr().out
        assert out.startswith(said)
        assert str(tmp_path / "mine") in out
    assert len(list(Path(tmp_path, "mine").glob("*.code-*/*.nbc"))) == 1


def test_the_command_makes_what_sentences_are_read_by(tmp_path):
    """For a server that can write nowhere; in a process that has read nothing yet."""
    mine = tmp_path / "mine"
    code = "from placegraph import cli; from placegraph.core import warm; warm.commands = dict; cli.main()"
    subprocess.run([sys.executable, "-c", code, "--compiled", mine, "warm"], check=True)  # noqa: S603
    made = {path.name.partition("-")[0] for path in mine.iterdir()}
    assert made >= {"grammar", "languages", "table"}


def test_a_kernel_not_found_has_all_of_its_command_compiled(monkeypatch):
    asked = []
    monkeypatch.setattr(
        warm, "warm", lambda calls, told: (asked.append(calls), told(calls[0]), [])[-1]
    )
    listener = Compiling(["scene", "build", "house.glb"])
    build = warm.commands()["scene build"]
    listener(_name(build[0]), done=True)
    listener("placegraph.no.such.kernel", done=False)
    assert asked == []
    listener(_name(build[0]), done=False)
    assert asked == [build]


@pytest.mark.parametrize("error", [BrokenPipeError(), BrokenProcessPool()])
def test_where_no_process_can_be_started_kernels_are_compiled_where_they_are_called(
    monkeypatch, error
):
    def refused(_calls, _told):
        raise error

    monkeypatch.setattr(warm, "warm", refused)
    build = warm.commands()["scene build"]
    Compiling(["scene", "build", "house.glb"])(_name(build[0]), done=False)


def test_nothing_is_compiled_elsewhere_where_nothing_can_be_kept(monkeypatch, capsys):
    monkeypatch.setattr(cache, "_is_writable", lambda _: False)
    monkeypatch.setattr(warm, "warm", None)
    build = warm.commands()["scene build"]
    with pytest.warns(UserWarning, match="each process compiles anew"):
        Compiling(["scene", "build", "house.glb"])(_name(build[0]), done=False)
    monkeypatch.setattr("sys.argv", ["placegraph", "warm"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == OptionError.exit_code
    assert "--compiled: name a folder that can be written" in capsys.readouterr().err


@pytest.mark.all
def test_the_list_is_complete(shared):
    from placegraph_lab.make.kernels import list_kernels

    today = list_kernels(shared / "data", lambda _: None)
    listed = files("placegraph").joinpath("kernels.txt").read_text("utf-8")
    assert set(today.splitlines()) <= set(listed.splitlines())
