"""Fixtures of the whole suite."""

import fcntl
import hashlib
import importlib.util
import io
import json
import os
import pickle
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

# Before NumPy is imported: threads of OpenBLAS wait busily for each other, and other tests run beside.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from xdist.scheduler import LoadScopeScheduling

import placegraph as pg
from placegraph import cli
from placegraph_lab.worlds.flat.flat import Flat

pytest_plugins = ["tests.browser", "tests.cities"]

_SLOW = [HealthCheck.too_slow]  # beside other load
settings.register_profile(
    "quick", deadline=None, derandomize=True, max_examples=30, suppress_health_check=_SLOW
)
settings.register_profile("thorough", deadline=None, suppress_health_check=_SLOW)
settings.load_profile("quick")

TESTS = Path(__file__).parent / "tests"
ALONE = ("test_docs.py", "test_examples.py", "test_goldens.py")
SHARED = Path(__file__).resolve().parents[1] / "shared"


class FolderScheduling(LoadScopeScheduling):
    """Run the tests of one folder in one worker, which builds their maps and servers once.

    Large folders come first. Pages, programs and goldens come last, one by one, so that no worker waits
    long for the other. pytest 9.2 ignores xdist's own groups.
    """

    def _split_scope(self, nodeid):
        path = nodeid.partition("::")[0]
        folder = path.rpartition("/")[0]
        if path.endswith(ALONE):
            return nodeid
        return path if folder == TESTS.name else folder


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    return FolderScheduling(config, log)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of shared real data, next to the repository; the test is skipped without it."""
    if not (SHARED / "data").is_dir():
        pytest.skip(f"needs ../shared: {SHARED} is not there")
    return SHARED


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20261121)


@dataclass
class Run:
    code: int
    out: str
    err: str

    @property
    def json(self):
        return json.loads(self.out)


@pytest.fixture
def run(monkeypatch, capsys):
    """Run the command line in this process: arguments and standard input to `Run`."""

    def placegraph(*arguments, stdin=""):
        monkeypatch.setattr(sys, "argv", ["placegraph", *map(str, arguments)])
        monkeypatch.setattr(sys, "stdin", io.StringIO(stdin))
        try:
            cli.main()
            code = 0
        except SystemExit as end:
            code = end.code or 0
        captured = capsys.readouterr()
        return Run(code, captured.out, captured.err)

    return placegraph


@pytest.fixture
def interrupted():
    """Run the command line in a process of its own, and press Ctrl-C `once` something is so."""
    # SIGINT is ignored by what a shell has started in the background, and by its children
    start = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    start += "from placegraph.cli import main; main()"

    def placegraph(*arguments, once, patience=120.0):
        command = [sys.executable, "-c", start, *map(str, arguments)]
        piped = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        process = subprocess.Popen(command, text=True, **piped)  # noqa: S603  # our own command
        end = time.monotonic() + patience
        try:
            while not once() and process.poll() is None and time.monotonic() < end:
                time.sleep(0.02)
            while process.poll() is None and time.monotonic() < end:
                process.send_signal(signal.SIGINT)  # again until it is seen
                with suppress(subprocess.TimeoutExpired):
                    process.wait(20.0)  # a second Ctrl-C would cut its last words short
            said = process.communicate(timeout=1.0)
            return Run(process.returncode, *said)
        finally:
            process.kill()
            process.wait()

    return placegraph


@pytest.fixture(scope="session")
def kitti360pose_world():
    """Module that writes a tiny KITTI360Pose in the published layout."""
    return _world("kitti360pose_world.py")


@pytest.fixture(scope="session")
def gotpr_world():
    """Module that writes a tiny GOTPR in the released layout."""
    return _world("gotpr_world.py")


@pytest.fixture(scope="session")
def scannet_world():
    """Module that writes a tiny ScanNet in the published layout."""
    return _world("scannet_world.py")


@pytest.fixture(scope="session")
def scan3r_world():
    """Module that writes a tiny 3RScan in the published layout."""
    return _world("scan3r_world.py")


def _world(name):
    path = Path(__file__).parent / "tests" / name
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def study() -> Flat:
    """Drawing of one furnished room, for walks that the command line is asked about."""
    return Flat.load("study")


@pytest.fixture(scope="session")
def make_city(tmp_path_factory):
    """City of a town drawn in ASCII; the same drawing is built once."""
    from tests.cities import osmium_in_process

    from placegraph.outdoor.city import build_city
    from placegraph_lab.worlds.town.town import Town

    known = {}

    def make(town, **options):
        town = Town.parse(town) if isinstance(town, str) else town
        key = (town.rows, town.metres, town.center, str(town.legend), tuple(options.items()))
        if key not in known:
            folder = tmp_path_factory.mktemp("town")
            osm = town.write_osm(folder / "town.osm")
            with osmium_in_process():
                known[key] = build_city(osm, folder / "town.city", **options)
        return known[key]

    return make


@pytest.fixture(scope="session")
def hafenstadt():
    from placegraph_lab.worlds.town.town import Town

    return Town.load("hafenstadt")


@pytest.fixture(scope="session")
def harbour(make_city, hafenstadt):
    """The shipped town as a city."""
    return make_city(hafenstadt)


@pytest.fixture(scope="session")
def harbour_file(harbour, tmp_path_factory):
    path = tmp_path_factory.mktemp("harbour") / "harbour.city"
    harbour.save(path)
    return path


@pytest.fixture(scope="session")
def common_folder(tmp_path_factory):
    """Folder that all workers of this run share."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session")
def demo_world(common_folder):
    """Folder with the demo's files and two maps made of them, made once for all workers.

    Copy it; what is written there would be seen by other tests.
    """
    from placegraph.demo.town import unpack

    folder = common_folder / "demo-world"
    with (common_folder / "demo-world.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.is_dir():
            made = unpack(common_folder / "demo-world.making")
            pg.build_city(made / "hafenstadt.osm", made / "hafenstadt.city")
            pg.build_scene(made / "altbau.glb", made / "altbau.scene")
            made.rename(folder)
    return folder


@pytest.fixture(scope="session", autouse=True)
def _known_surfaces(common_folder):
    """Compute once how the surfaces of a map look: it takes a second, and libraries ask again."""
    from placegraph.indoor.encode import appearance

    compute = appearance.surfaces

    def surfaces(scene):
        bare = replace(scene, anchors=(), source="", encoder="", landmarks=None)
        name = hashlib.sha256(pickle.dumps(bare)).hexdigest()
        file = common_folder / f"surfaces-{name}.npz"
        if not file.exists():
            means, cells = compute(scene)
            made = file.with_suffix(f".{os.getpid()}.npz")
            np.savez(made, means=means, cells=cells)
            made.replace(file)
        with np.load(file) as known:
            return known["means"], known["cells"]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(appearance, "surfaces", surfaces)
        yield
