"""Files written whole, work shared by threads, and pickles."""

import os
import pickle
import threading
from pathlib import Path

import numpy as np
import pytest

import placegraph as pg
from placegraph.core import files
from placegraph.core.estimate import Evidence, LazyEvidence, Place
from placegraph.core.files import check_regular, write_file, write_output
from placegraph.core.geometry import Camera
from placegraph.core.jit import kernel
from placegraph.core.threads import count_processors, limit_threads, run_parallel
from placegraph.errors import InputError, MapError, MapLockedError, OptionError
from placegraph.indoor.encode.labels import Confusion
from placegraph.indoor.encode.networks import ImageNetwork
from placegraph.indoor.library.library import hash_file
from placegraph.io.capture.capture import Frame
from placegraph_learn.scenegraphloc.features import read_attributes


def test_a_file_takes_the_place_of_the_old_one_and_a_link_stays_one(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    assert write_file(path, [b"ne", memoryview(b"w")]) == path
    assert path.read_bytes() == b"new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]
    (tmp_path / "far").mkdir()
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "far" / "a.bin")
    write_file(link, [b"new"])
    assert link.is_symlink()
    assert (tmp_path / "far" / "a.bin").read_bytes() == b"new"


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def chunks():
        yield b"half"
        raise OSError(28, "No space left on device")

    with pytest.raises(MapError, match="No space left"):
        write_file(path, chunks())
    monkeypatch.setattr(files, "_sync_folder", lambda _: Path("/does/not/exist").stat())
    with pytest.raises(MapError, match="cannot be written"):
        write_file(tmp_path / "b.bin", [b"new"])
    assert path.read_bytes() == b"old"
    assert not list(tmp_path.glob(".*"))


def test_what_cannot_be_written_is_said(tmp_path):
    with pytest.raises(MapError, match="not a regular file"):
        write_file(tmp_path, [b""])
    with pytest.raises(MapError, match="cannot be written"):
        write_file(tmp_path / "no" / "a.bin", [b""])
    with pytest.raises(MapError, match="not a valid file name"):
        write_file("a\0b", [b""])
    with files.lock_file(tmp_path / "a.bin"), pytest.raises(MapLockedError, match=r"a\.bin"):
        write_file(tmp_path / "a.bin", [b""])


def test_a_link_where_the_temporary_file_stands_is_not_followed(tmp_path):
    precious = tmp_path / "precious"
    precious.write_bytes(b"old")
    (tmp_path / ".a.bin.tmp").symlink_to(precious)
    write_file(tmp_path / "a.bin", [b"new"])
    assert precious.read_bytes() == b"old"
    assert (tmp_path / "a.bin").read_bytes() == b"new"
    assert not (tmp_path / "a.bin").is_symlink()


def test_what_may_never_end_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    for name in ("pipe", "link"):
        with pytest.raises(InputError, match=f"{name} is not a regular file"):
            check_regular(tmp_path / name)
    assert check_regular(tmp_path) == tmp_path
    assert check_regular(tmp_path / "none") == tmp_path / "none"


def test_what_is_put_is_whole_or_not_there(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    assert write_output(path, b"old") == path
    monkeypatch.setattr(os, "fsync", lambda _: Path("/does/not/exist").stat())
    with pytest.raises(InputError, match=r"a\.png cannot be written: No such file"):
        write_output(path, b"new")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
    for wrong in (tmp_path / "no" / "a.png", tmp_path, "a\0b"):
        with pytest.raises(InputError, match="cannot be written"):
            write_output(wrong, b"new")


def test_what_is_no_file_is_written_straight(tmp_path):
    read, write = os.pipe()
    write_output(f"/dev/fd/{write}", b"through a pipe")
    assert os.read(read, 100) == b"through a pipe"
    os.close(read)
    os.close(write)
    with (tmp_path / "open").open("w") as file:
        write_output(f"/proc/self/fd/{file.fileno()}", b"into an open file")
    assert (tmp_path / "open").read_bytes() == b"into an open file"


def test_a_folder_that_is_lost_meanwhile_leaves_the_first_error(tmp_path, monkeypatch):
    path, removed = tmp_path / "a.bin", Path.unlink

    def refused(self, *given, **named):
        if self.name.startswith(".a.bin"):
            raise PermissionError(13, "Permission denied", str(self))
        removed(self, *given, **named)

    def chunks():
        monkeypatch.setattr(Path, "unlink", refused)
        yield b"half"
        raise OSError(28, "No space left on device")

    with pytest.raises(MapError, match="No space left"):
        write_file(path, chunks())
    monkeypatch.undo()
    write_file(path, [b"new"])
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]


def test_no_reader_of_weights_words_or_maps_reads_a_device(tmp_path):
    for read, ending in (
        (read_attributes, ".txt"),
        (Confusion.open, ".csv"),
        (ImageNetwork, ".tflite"),
        (hash_file, ".scene"),
    ):
        (tmp_path / f"a{ending}").symlink_to("/dev/null")  # as /dev/zero, but it ends
        with pytest.raises(InputError, match="is not a regular file"):
            read(tmp_path / f"a{ending}")


@kernel
def _count(amount, out, first, last):
    for row in range(first, last):
        out[row] += amount


@pytest.mark.parametrize("most", [None, 1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 2, 7, 1000])
def test_every_row_once(count, most):
    out = np.zeros(count, np.int64)
    if most is None:
        run_parallel(_count, count, 3, out)
    else:
        with limit_threads(most):
            run_parallel(_count, count, 3, out)
    assert (out == 3).all()


def test_many_ask_at_once():
    outs = [np.zeros(5000, np.int64) for _ in range(6)]
    asked = [
        threading.Thread(target=run_parallel, args=(_count, 5000, i, out))
        for i, out in enumerate(outs)
    ]
    for thread in asked:
        thread.start()
    for thread in asked:
        thread.join()
    assert all((out == i).all() for i, out in enumerate(outs))


def _sees_every_row():
    out = np.zeros(1000, np.int64)
    run_parallel(_count, 1000, 3, out)
    return (out == 3).all()


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.skipif(count_processors() < 2, reason="one processor has no helpers")
def test_helpers_are_kept_and_a_fork_has_its_own():
    def helpers():
        return {t.ident for t in threading.enumerate() if t.name.startswith("placegraph")}

    assert _sees_every_row()
    before = helpers()
    assert 0 < len(before) < count_processors()
    assert _sees_every_row()
    assert before <= helpers()
    child = os.fork()
    if not child:
        os._exit(0 if _sees_every_row() else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_one_thread_is_the_caller_and_errors_of_parts_are_raised():
    seen = []
    with limit_threads(1):
        run_parallel(lambda first, last: seen.append((threading.get_ident(), first, last)), 100)
    assert seen == [(threading.get_ident(), 0, 100)]
    with pytest.raises(OptionError, match="at least 1"), limit_threads(0):
        pass

    def fail(first, last):
        raise ValueError(f"{first} to {last}")

    with pytest.raises(ValueError, match="to"):
        run_parallel(fail, 100)
    assert count_processors() >= 1


SAID = "A bakery is north of me. The church is east of the bakery."


def sent(thing):
    return pickle.loads(pickle.dumps(thing))  # noqa: S301  # our own


@pytest.fixture(scope="module")
def flat(demo_world):
    return pg.open_map(demo_world / "altbau.scene")


@pytest.fixture(scope="module")
def walk(demo_world):
    return pg.open_capture(demo_world / "walk")


def test_evidence_travels_and_what_found_it_does_not():
    evidence = (Evidence("chair 17", "for", 3.5),)
    here = Place(9.0, 53.0, 1.0, "c0r0", np.eye(2), explain=lambda: evidence)
    there = sent(here)
    assert there.evidence == there.explain() == evidence
    assert isinstance(there, LazyEvidence)


def test_a_city_and_what_was_found_in_it(harbour):
    estimate = harbour.locate(SAID)
    there = sent(harbour)
    assert len(pickle.dumps(harbour)) < 50_000  # tables of the search are made again
    assert there.digest == harbour.digest
    assert there.locate(SAID).to_dict() == estimate.to_dict()
    assert len(pickle.dumps(estimate)) < 100_000
    assert sent(estimate).to_dict() == estimate.to_dict()
    assert estimate.map is harbour
    assert sent(estimate).map is None


def test_a_scene_a_capture_and_a_pose(flat, walk):
    frames = slice(0, 3)
    estimate = flat.localize(walk, frames=frames)
    there, clip = sent(flat), sent(walk)
    assert len(pickle.dumps(flat)) < 1_000_000
    assert len(pickle.dumps(walk)) < 20_000
    np.testing.assert_array_equal(clip[0].depth(), walk[0].depth())
    again = there.localize(clip, frames=frames)
    np.testing.assert_array_equal(again.best.pose, estimate.best.pose)
    assert len(pickle.dumps(estimate)) < 50_000
    assert sent(estimate).to_dict() == estimate.to_dict()


def test_arrays_that_nobody_may_write_stay_so(flat, harbour):
    for here, there in ((flat, sent(flat)), (harbour, sent(harbour))):
        pairs = [(here, there)]
        while pairs:
            a, b = pairs.pop()
            names = getattr(type(a), "__dataclass_fields__", ())
            for one, other in ((getattr(a, n), getattr(b, n)) for n in names):
                if isinstance(one, np.ndarray):
                    assert one.flags.writeable == other.flags.writeable
                    np.testing.assert_array_equal(one, other)
                pairs.append((one, other))


def test_a_library_takes_along_the_maps_that_no_file_holds(demo_world, flat):
    library = pg.SceneLibrary("labels")
    library.add("file", demo_world / "home1.scene")
    library.add("memory", flat)
    library.search("a kitchen")
    there = sent(library)
    assert there.names == ("file", "memory")
    assert len(there.scene("memory")) == len(flat)
    assert there.search("a kitchen").best.scene == library.search("a kitchen").best.scene


def test_frames_in_memory():
    camera = Camera(4, 3, 4.0, 4.0, 2.0, 1.5)
    frame = Frame.from_arrays(np.zeros((3, 4, 3), np.uint8), camera, depth=np.ones((3, 4)))
    there = sent(frame)
    assert there.depth().tolist() == frame.depth().tolist()
    assert not there.gravity.flags.writeable
