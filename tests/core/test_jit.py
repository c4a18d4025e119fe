"""Compiled kernels: found again, kept, and compiled before they are called."""

import ast
import importlib.util
import inspect
import resource
import signal
import subprocess
import sys
import warnings
from collections import namedtuple
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from pkgutil import walk_packages

import numpy as np
import pytest
from numba import typeof
from numba.core import config, types

from placegraph import cli
from placegraph.cli.compiling import CompileListener
from placegraph.core import cache, warm
from placegraph.core.jit import Kernel, cache_key, defer_signals, kernel
from placegraph.errors import OptionError
from placegraph_lab.make.kernels import spell_call

CALLEE = """
from placegraph.core.jit import kernel
FACTOR = {factor}

@kernel{options}
def times(x):
    {docstring}
    return FACTOR * x
"""
CALLER = """
from placegraph.core.jit import kernel
from compiled_callee import times

@kernel
def total(values):
    out = 0.0
    for value in values:
        out += times(value)
    return out
"""
BOTH = ["compiled_caller.total", "compiled_callee.times"]


@pytest.fixture(autouse=True)
def _fresh(monkeypatch, tmp_path):
    monkeypatch.setattr(cache, "FOLDERS", cache.CacheFolders())
    cache.FOLDERS.choose(tmp_path / "kept")


@pytest.fixture
def total(monkeypatch, tmp_path):
    """Import both files anew, as another process would; says the sum and what was compiled."""

    def import_and_call(values, *, factor=3, options="", docstring='"""Docstring."""'):
        texts = {"callee": CALLEE.format(factor=factor, options=options, docstring=docstring)}
        for name, text in (texts | {"caller": CALLER}).items():
            path = tmp_path / f"compiled_{name}.py"
            path.write_text(text)
            spec = importlib.util.spec_from_file_location(path.stem, path)
            module = importlib.util.module_from_spec(spec)
            monkeypatch.setitem(sys.modules, path.stem, module)
            exec(compile(text, path, "exec"), module.__dict__)  # noqa: S102  # never from a .pyc
        told = []
        with cache.listen_to_compilation(lambda name, done: told.append((name, done))):
            answer = module.total(values)
        begun = [name for name, done in told if not done]
        assert sorted(begun) == sorted(name for name, done in told if done)
        return answer, begun

    return import_and_call


def test_compiled_once_for_each_signature(total):
    assert total(np.arange(4.0)) == (18.0, BOTH)
    assert total(np.arange(4.0)) == (18.0, [])
    assert total(np.arange(4.0, dtype=np.float32)) == (18.0, BOTH)
    readonly = np.arange(4.0)
    readonly.flags.writeable = False
    assert total(readonly) == (18.0, BOTH[:1])


def test_a_change_of_code_in_another_file_is_noticed_and_no_other(total):
    values = np.arange(4.0)
    assert total(values)[1] == BOTH
    assert total(values, factor=5) == (30.0, BOTH)
    assert total(values, options="(fastmath=True)")[1] == BOTH
    assert total(values, options="(error_model='numpy')")[1] == BOTH
    assert total(values) == (18.0, [])
    assert total(values, docstring='"""Other."""  # and a comment') == (18.0, [])


@kernel(finite=True)
def _as_written(values, factors):
    total = np.float32(0.0)
    for i in range(len(values)):
        total += values[i] * factors[i]
    return total


def test_sums_of_finite_numbers_keep_their_order():
    # a compiler that may add in another order adds several at a time, and multiplies without rounding
    rng = np.random.default_rng(0)
    draws = [rng.normal(size=(2, 1001)).astype(np.float32) for _ in range(20)]
    sums = [np.cumsum(values * factors)[-1] for values, factors in draws]
    assert [_as_written(*draw) for draw in draws] == sums
    fast = kernel(_as_written.py_func, fastmath=True)
    assert [fast(*draw) for draw in draws] != sums


def test_answers_about_places_hang_on_no_compiler():
    for room in ("likelihood", "map", "search", "track"):
        package = import_module(f"placegraph.outdoor.{room}")
        for module in walk_packages(package.__path__, f"{package.__name__}."):
            for name, value in vars(import_module(module.name)).items():
                if isinstance(value, Kernel):
                    assert value.targetoptions.get("fastmath") is not True, name


def test_a_file_cut_short_is_made_again(total, tmp_path):
    total(np.arange(4.0))
    (file,) = tmp_path.glob("kept/compiled_caller.total-*/*.nbc")
    whole = file.read_bytes()
    for size in (0, 10, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:size])
        assert total(np.arange(4.0)) == (18.0, BOTH[:1])
        assert total(np.arange(4.0)) == (18.0, [])


def test_constants_and_named_tuples_of_every_kind_are_told_apart():
    values = [
        1, 1.0, True, "1", None, (1, 2), (2, 1), [1, 2], {"a": 1}, {"b": 1}, np.float32(1), np.int64(1),
        np.array([1.0, 2.0]), np.array([1.0, 3.0]), np.array([[1.0, 2.0]]), np.sqrt, np.sin, np, abs,
    ]  # fmt: skip
    assert len({cache_key(value) for value in values}) == len(values)
    assert cache_key({"a", "b", "c"}) == cache_key({"c", "b", "a"})
    with pytest.raises(TypeError, match="whose changes the compiled-code cache cannot detect"):
        cache_key(object())
    kinds = [("x y", "here"), ("y x", "here"), ("x y", "there")]
    points = [namedtuple("Point", fields, module=home)(1, 2) for fields, home in kinds]  # noqa: PYI024
    assert len({cache_key(typeof(point)) for point in points}) == 3


def _full(*_):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize(
    "missing",
    [
        ("placegraph.core.cache._write", _full),
        ("placegraph.core.cache._is_writable", lambda _: False),
    ],
)
def test_where_nothing_can_be_written_code_is_compiled_all_the_same(
    total, monkeypatch, tmp_path, missing
):
    monkeypatch.setattr(*missing)
    with warnings.catch_warnings(record=True, action="always") as said:
        assert total(np.arange(4.0)) == (18.0, BOTH)
        assert total(np.arange(4.0)) == (18.0, BOTH)
        assert cache.load_or_make("grammar", lambda: b"made", bytes.decode) == "made"
    told = [str(each.message) for each in said]
    assert len(told) == 1
    assert "so every process compiles again. Choose a" in told[0]
    assert not list(tmp_path.glob("**/*.nbc"))


def test_a_full_disk_is_told_from_one_that_takes_files_of_nothing(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    assert cache._is_writable(tmp_path)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    try:
        (tmp_path / "empty").touch()
        assert not cache._is_writable(tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_the_chosen_folder_comes_before_the_set_one_and_that_before_our_own(monkeypatch, tmp_path):
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "set"))
    assert cache.FOLDERS.read == [tmp_path / "kept"]
    cache.FOLDERS.choose(None)
    assert cache.FOLDERS.read == [tmp_path / "set"]
    monkeypatch.setattr(config, "CACHE_DIR", "")
    own, user = cache.FOLDERS.read
    assert own.parts[-3:] == ("placegraph", "__pycache__", "kernels")
    assert user.name == "kernels"


def test_what_is_shipped_beside_the_package_is_read_and_the_rest_kept_elsewhere(
    total, monkeypatch, tmp_path
):
    total(np.arange(4.0))
    shipped, user = tmp_path / "kept", tmp_path / "user"
    monkeypatch.setattr(cache.CacheFolders, "read", [shipped, user])
    monkeypatch.setattr(cache, "_is_writable", lambda folder: folder != shipped)
    cache.FOLDERS.choose(None)
    assert total(np.arange(4.0)) == (18.0, [])
    assert not user.exists()
    assert total(np.arange(4)) == (18.0, BOTH)
    assert len(list(user.glob("*/*.nbc"))) == 2


def test_two_processes_compile_nothing_twice(total, tmp_path):
    total(np.arange(4.0))  # writes both files
    program = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "import numpy as np; from placegraph.core import cache; from compiled_caller import total\n"
        "cache.FOLDERS.choose(sys.argv[2])\n"
        "print('ready', flush=True); input()\n"
        "with cache.listen_to_compilation(lambda name, done: print(name) if done else None):\n"
        "    total(np.arange(3.0))\n"
    )
    processes = [
        subprocess.Popen(  # noqa: S603
            [sys.executable, "-c", program, tmp_path, tmp_path / "new"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )
        for _ in range(2)
    ]  # fmt: skip
    for process in processes:
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        process.stdin.write("\n")
        process.stdin.flush()
    compiled_by = [process.communicate()[0].split() for process in processes]
    assert [process.returncode for process in processes] == [0, 0]
    assert sorted(compiled_by[0] + compiled_by[1]) == sorted(BOTH)


PRESSED = """
import signal, sys; sys.path.insert(0, sys.argv[1])
signal.signal(signal.SIGINT, signal.default_int_handler)
import numpy as np; from placegraph.core import cache; from compiled_caller import total
from numba.core.registry import cpu_target
cache.FOLDERS.choose(sys.argv[2])
llvm = cpu_target.target_context.codegen()._engine._ee
asked = llvm._object_cache_getbuffer
def pressed(module):
    signal.raise_signal(signal.SIGINT)
    return asked(module)
llvm._object_cache_getbuffer = pressed
try:
    total(np.arange(3.0))
except KeyboardInterrupt:
    llvm._object_cache_getbuffer = asked
    print("interrupted, then", total(np.arange(3.0)))
"""


@pytest.mark.parametrize("kept_before", [True, False])
def test_ctrl_c_where_llvm_asks_for_code_waits_until_it_has_it(total, tmp_path, kept_before):
    total(np.arange(3.0))  # writes both files
    folder = tmp_path / ("kept" if kept_before else "new")
    command = [sys.executable, "-c", PRESSED, tmp_path, folder]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    assert (done.returncode, done.stdout) == (0, "interrupted, then 9.0\n"), done.stderr


def test_signals_wait_and_none_is_lost(monkeypatch):
    told = []
    before = signal.signal(signal.SIGUSR1, lambda number, _: told.append(number))
    monkeypatch.setattr("placegraph.core.jit._SIGNALS", ("SIGUSR1", "SIGUSR2", "SIGNONE"))
    try:
        with defer_signals():
            with defer_signals():
                signal.raise_signal(signal.SIGUSR1)
            signal.raise_signal(signal.SIGUSR1)
            assert told == []
        assert told == 2 * [signal.SIGUSR1]
        signal.raise_signal(signal.SIGUSR1)
        assert len(told) == 3
        with ThreadPoolExecutor(1) as pool, defer_signals():
            assert pool.submit(_uninterrupted_elsewhere).result() == "done"
    finally:
        signal.signal(signal.SIGUSR1, before)


def _uninterrupted_elsewhere():
    with defer_signals():
        return "done"


CALLS = list(dict.fromkeys(call for calls in warm.list_calls().values() for call in calls))
SMALL = next(call for call in CALLS if ".encode_rows(" in call)


def _name(call):
    return f"placegraph.{call.partition('(')[0]}"


def test_calls_are_kernels_and_types_of_today_and_read_as_they_are_spelled():
    words = warm._type_names()
    definitions = (line.split(" = ") for line in warm._lines() if " = " in line)
    names = {text: name for name, text in definitions}
    for name in names.values():
        assert len(words[name]) == len(words[name].instance_class._fields), name
    for call in CALLS:
        kernel, args = warm._resolve(call), warm._parse_types(call, words)
        assert len(args) == len(inspect.signature(kernel.py_func).parameters), call
        assert spell_call(kernel, args, names) == call
    args = (
        types.float64, types.Array(types.float32, 2, "C"), types.Array(types.uint8, 3, "A"),
        types.Array(types.int64, 2, "F"), types.Array(types.int32, 1, "C", readonly=True),
        types.UniTuple(types.int64, 2), types.Tuple((types.boolean, types.float64)),
        words["Surfaces"], types.Omitted(1), types.none,
    )  # fmt: skip
    assert warm._parse_types(spell_call(warm._resolve(SMALL), args, names), words) == args


def test_the_simplest_kind_of_a_command():
    build = warm.list_calls()["scene build"]
    flood, fused = (
        _name(next(call for call in CALLS if end in call))
        for end in (".flood_basins(", ".integrate(")
    )
    assert warm.calls_with(flood, ["scene", "build", "x"]) == build
    assert len(warm.calls_with(fused, ["scene", "build", "x"])) > len(build)
    assert warm.calls_with(fused, ["city", "locate", "x"]) == []


def test_compiled_before_it_is_called():
    told = []
    assert warm.missing_calls([SMALL, SMALL]) == [SMALL]
    bad = SMALL.removesuffix("int32[::1])") + "float64)"
    failed = warm.compile_calls([SMALL, bad], told.append)
    assert sorted(told) == sorted([SMALL, bad])
    assert [reason.split(":")[0] for reason in failed] == [bad.split(":")[0]]
    assert warm.missing_calls([SMALL]) == []


def test_the_command_compiles_what_is_missing(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(warm, "list_calls", lambda: {"scene build": [SMALL]})
    monkeypatch.setattr("sys.argv", ["placegraph", "--compiled", str(tmp_path / "mine"), "warm"])
    for said in ("1 of 1 functions compiled in", "0 of 1 functions compiled in"):
        with pytest.raises(SystemExit) as end:
            cli.main()
        assert not end.value.code
        out = capsys.readouterr().out
        assert out.startswith(said)
        assert str(tmp_path / "mine") in out
    assert len(list(Path(tmp_path, "mine").glob("*.encode_rows-*/*.nbc"))) == 1


def test_the_command_makes_what_sentences_are_read_by(tmp_path):
    mine = tmp_path / "mine"
    code = "from placegraph import cli; from placegraph.core import warm; warm.list_calls = dict; cli.main()"
    subprocess.run([sys.executable, "-c", code, "--compiled", mine, "warm"], check=True)  # noqa: S603
    made = {path.name.partition("-")[0] for path in mine.iterdir()}
    assert made >= {"grammar", "languages", "table"}


def test_a_kernel_not_found_has_all_of_its_command_compiled(monkeypatch):
    asked = []
    monkeypatch.setattr(
        warm, "compile_calls", lambda calls, told: (asked.append(calls), told(calls[0]), [])[-1]
    )
    listener = CompileListener(["scene", "build", "house.glb"])
    build = warm.list_calls()["scene build"]
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

    monkeypatch.setattr(warm, "compile_calls", refused)
    build = warm.list_calls()["scene build"]
    CompileListener(["scene", "build", "house.glb"])(_name(build[0]), done=False)


def test_nothing_is_compiled_elsewhere_where_nothing_can_be_kept(monkeypatch, capsys):
    monkeypatch.setattr(cache, "_is_writable", lambda _: False)
    monkeypatch.setattr(warm, "compile_calls", None)
    build = warm.list_calls()["scene build"]
    with pytest.warns(UserWarning, match="so every process compiles again"):
        CompileListener(["scene", "build", "house.glb"])(_name(build[0]), done=False)
    monkeypatch.setattr("sys.argv", ["placegraph", "warm"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == OptionError.exit_code
    assert "--compiled: the folder is not writable" in capsys.readouterr().err


@pytest.mark.all
def test_the_list_is_complete(shared):
    from placegraph_lab.make.kernels import list_kernels

    today = list_kernels(shared / "data", lambda _: None)
    listed = files("placegraph").joinpath("kernels.txt").read_text("utf-8")
    assert set(today.splitlines()) <= set(listed.splitlines())


def test_no_kernel_needs_scipy():
    """Numba compiles `numpy.linalg` and products of matrices only with SciPy, which the core lacks."""
    root = Path(str(files("placegraph")))
    for path in root.rglob("*_kernels.py"):
        tree = ast.parse(path.read_text("utf-8"))
        kernels = [
            f for f in ast.walk(tree)
            if isinstance(f, ast.FunctionDef) and any("kernel" in ast.unparse(d) for d in f.decorator_list)
        ]  # fmt: skip
        for f in kernels:
            needs = [n for n in ast.walk(f) if isinstance(getattr(n, "op", None), ast.MatMult)]
            assert not needs, f"{path.name}: {f.name}"
            assert "linalg" not in ast.unparse(f), f"{path.name}: {f.name}"
