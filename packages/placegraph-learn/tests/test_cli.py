import json
import shutil

import pytest
from PIL import Image

from placegraph.errors import OptionError
from placegraph.outdoor.network.weights import read_weights
from placegraph_lab.worlds.home.lessons import homes
from placegraph_learn.cli import ShownProgress, choose_worlds

TINY = ("--epochs", 2, "--examples", 4, "--steps", 1, "--batch", 2, "--check", 2, "--device", "cpu")
TEXT = "I am on Speicherweg. The museum is south of me."


@pytest.fixture(scope="module")
def city(harbour, tmp_path_factory):
    path = tmp_path_factory.mktemp("train") / "town.city"
    harbour.save(path)
    return path


@pytest.fixture(scope="module")
def pools(tmp_path_factory):
    return tmp_path_factory.mktemp("pools")


def test_train_writes_weights_a_table_and_curves(run, city, pools, tmp_path):
    out, work, words = (tmp_path / name for name in ("a.weights", "work", "words.txt"))
    words.write_text("2 3\nmuseum 1 2 3\nhouse 3 2 1\n", "utf-8")
    given = ("city", "train", city, "-o", out, "--work", work, "--pools", pools, *TINY)
    assert run(*given, "--word-vectors", tmp_path / "gone.txt").code != 0
    given = (*given, "--word-vectors", words)
    result = run(*given)
    assert (result.code, result.err) == (0, "")
    header, first, second, last = result.out.splitlines()
    assert header.split()[:4] == ["epoch", "match", "similarity", "embedding"]
    assert (first.split()[0], second.split()[0]) == ("1", "2")
    assert len(first) == len(second) == len(header)
    assert last.startswith(f"{out}: {out.stat().st_size:,} bytes")
    weights = read_weights(out)
    assert len(weights.training["curves"]) == 2
    assert set(weights.words.words) <= {"museum", "house"}
    with Image.open(work / "curves.png") as drawn:
        assert len(drawn.getcolors(1 << 20)) > 20
    assert {path.suffix for path in pools.iterdir()} == {".pool"}
    again = run(*given, "--json")
    assert again.json["fingerprint"] == weights.digest
    assert [row["epoch"] for row in again.json["curves"]] == [1, 2]
    here = run("city", "locate", city, TEXT, "--weights", out, "--matcher", "transformer", "--json")
    assert here.json["modes"]


def test_ctrl_c_says_how_to_go_on(run, city, pools, tmp_path, monkeypatch):
    out, work = tmp_path / "a.weights", tmp_path / "work"
    command = ("city", "train", city, "-o", out, "--work", work, "--pools", pools, *TINY)

    def interrupt(self, epoch, done, total, losses):  # noqa: ARG001
        if epoch == 1:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(ShownProgress, "step", interrupt)
        result = run(*command)
    assert result.code == 130
    assert "Interrupted; 1 epoch is saved" in result.err
    assert f"placegraph city train {city}" in result.err
    assert not out.exists()
    gone_on = run(*command)
    assert gone_on.code == 0
    assert [line.split()[0] for line in gone_on.out.splitlines()[1:-1]] == ["2"]


def test_homes_are_those_of_the_lab():
    assert [w.name for w in choose_worlds(None, 3, 2, 5)] == [w.name for w in homes(3, seed=5)]


def test_the_papers_network_is_trained_and_locates(run, city, pools, tmp_path):
    out = tmp_path / "paper.weights"
    made = run(
        "city", "train", city, "-o", out, "--work", tmp_path / "work", "--pools", pools, *TINY,
        "--losses", "eq17,eq18", "--printed", "--layers", 1, "--crossings", 1, "--heads", 2,
        "--json",
    )  # fmt: skip
    assert (made.code, made.err) == (0, "")
    assert [*made.json["curves"][0]][:3] == ["epoch", "eq17", "eq18"]
    shape = read_weights(out).shape
    assert (shape.layers, shape.crossings, shape.heads, shape.printed) == (1, 1, 2, True)
    found = run("city", "locate", city, TEXT, "--preset", "paper", "--weights", out, "--json")
    assert found.json["modes"]


def test_what_cannot_be_trained_is_refused_at_once(run, city, pools, tmp_path):
    out, work, other = tmp_path / "a.weights", tmp_path / "work", tmp_path / "other"
    other.mkdir()
    (other / "plan.json").write_text("{}", "utf-8")
    here = (city, "-o", out, "--work", work)
    for arguments, code, words in (
        ((tmp_path / "gone.city", "-o", out, "--work", work), 3, "gone.city"),
        ((city, "-o", tmp_path / "no" / "a.weights", "--work", work), 4, "a.weights"),
        ((city, *here), 7, "Several maps are named town"),
        ((*here, "--epochs", 0), 7, "epochs is 0"),
        ((city, "-o", out, "--work", other, "--pools", pools, *TINY), 7, "another"),
        ((*here, "--pools", pools, *TINY[:-1], "abacus"), 7, "choose 'cpu', 'cuda' or 'auto'"),
        ((*here, *TINY, "--rate", 50), 7, "rate is 50"),
        ((*here, *TINY, "--heads", 5), 7, "width 48 does not fit 5 heads"),
        ((*here, *TINY, "--printed"), 7, "the printed network does not read"),
    ):
        result = run("city", "train", *arguments)
        assert (result.code, words in result.err) == (code, True), result.err
    assert not out.exists()


@pytest.fixture(scope="module")
def maps(room, walk, tmp_path_factory):
    at = tmp_path_factory.mktemp("maps")
    for name in "abc":
        room.save(at / f"{name}.scene")
        shutil.copytree(walk.path, at / name)
    return at


def test_the_command_trains_and_goes_on(run, maps, tmp_path, monkeypatch):
    out, work = tmp_path / "a.safetensors", tmp_path / "work"
    words = (maps, "-o", out, "--work", work, "--epochs", 1, "--points", 8, "--device", "cpu")

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(ShownProgress, "step", interrupt)
        result = run("scene", "train", *words)
    assert result.code == 130
    assert "Resu" in result.err
    result = run("scene", "train", *words)
    assert (result.code, result.err) == (0, "")
    header, first, last = result.out.splitlines()
    assert header.split() == ["epoch", "loss", "patch", "room"]
    assert first.split()[0] == "1"
    assert last.startswith(f"{out}: {out.stat().st_size:,} bytes")
    assert (work / "curves.png").stat().st_size > 1000
    again = run("scene", "train", *words, "--json")
    assert again.json["notes"]["features"] == "colour-1"
    assert [row["epoch"] for row in again.json["curves"]] == [1]
    assert json.loads((work / "plan.json").read_text("utf-8"))["held"] == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "either a folder"),
        (("maps", "--synthetic", 3), "either a folder"),
        (("nowhere",), "scene build"),
        (("--synthetic", 3, "--width", "huge"), "small or published"),
        (("--synthetic", 3, "--features", "sift"), "one of dinov2, colour"),
    ],
)
def test_wrong_commands_say_what_is_wrong(run, tmp_path, arguments, said):
    result = run("scene", "train", *arguments, "-o", tmp_path / "a.safetensors",
                 "--work", tmp_path / "work")  # fmt: skip
    assert result.code == OptionError.exit_code
    assert said in result.err
