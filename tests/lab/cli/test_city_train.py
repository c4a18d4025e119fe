"""`placegraph city train`, and the options by which its weights are used."""

import inspect
import json
import sys

import pytest
from PIL import Image

from placegraph.outdoor.network.weights import read_weights
from placegraph_lab.cli import city_train
from placegraph_lab.worlds.town.town import Town
from placegraph_learn.train.city.train import TrainOptions

TINY = ("--epochs", 2, "--examples", 6, "--steps", 2, "--batch", 3, "--check", 3, "--device", "cpu")
TEXT = "I am on Speicherweg. The museum is south of me."


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    from placegraph.outdoor.city import build_city

    folder = tmp_path_factory.mktemp("train")
    build_city(Town.load("hafenstadt").write_osm(folder / "town.osm"), folder / "town.city")
    return folder / "town.city"


@pytest.fixture(scope="module")
def pools(tmp_path_factory):
    return tmp_path_factory.mktemp("pools")


@pytest.fixture
def needs_torch():
    torch = pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")
    before = torch.get_num_threads()
    torch.set_num_threads(1)  # so small are these networks
    yield
    torch.set_num_threads(before)


@pytest.fixture
def weights(tmp_path):
    """Random weights; training is not what is tested with them."""
    import numpy as np

    from placegraph.outdoor.network.weights import Shape, trained, write_weights

    shape, rng = Shape(width=8, dimension=8, heads=2, evidence=4), np.random.default_rng(3)
    state = {name: rng.normal(scale=0.3, size=size) for name, size in shape.arrays().items()}
    write_weights(tmp_path / "a.weights", trained(shape, state, {}))
    return tmp_path / "a.weights"


# --- train ---


@pytest.mark.usefixtures("needs_torch")
def test_train_writes_weights_a_table_and_curves(run, city, pools, tmp_path):
    out, work = tmp_path / "a.weights", tmp_path / "work"
    result = run("city", "train", city, "-o", out, "--work", work, "--pools", pools, *TINY)
    assert (result.code, result.err) == (0, "")
    header, first, second, last = result.out.splitlines()
    assert header.split()[:4] == ["epoch", "match", "similarity", "embedding"]
    assert (first.split()[0], second.split()[0]) == ("1", "2")
    assert len(first) == len(second) == len(header)
    assert last.startswith(f"{out}: {out.stat().st_size:,} bytes")
    assert len(read_weights(out).training["curves"]) == 2
    with Image.open(work / "curves.png") as drawn:
        assert len(drawn.getcolors(1 << 20)) > 20
    assert {path.suffix for path in pools.iterdir()} == {".pool"}
    again = run("city", "train", city, "-o", out, "--work", work, "--pools", pools, *TINY, "--json")
    assert again.json["fingerprint"] == read_weights(out).fingerprint
    assert [row["epoch"] for row in again.json["curves"]] == [1, 2]


@pytest.mark.usefixtures("needs_torch")
def test_train_takes_word_vectors(run, city, pools, tmp_path):
    out, work, words = (tmp_path / name for name in ("a.weights", "work", "words.txt"))
    words.write_text("2 3\nmuseum 1 2 3\nhouse 3 2 1\n", "utf-8")
    given = ("city", "train", city, "-o", out, "--work", work, "--pools", pools, *TINY, "--quiet")
    assert run(*given, "--word-vectors", tmp_path / "gone.txt").code != 0
    assert run(*given, "--word-vectors", words).code == 0
    assert set(read_weights(out).words.words) <= {"museum", "house"}
    here = run("city", "locate", city, TEXT, "--weights", out, "--matcher", "transformer", "--json")
    assert here.json["modes"]


@pytest.mark.usefixtures("needs_torch")
def test_ctrl_c_says_how_to_go_on(run, city, pools, tmp_path, monkeypatch):
    from placegraph_lab.cli.city_train_shown import Shown

    out, work = tmp_path / "a.weights", tmp_path / "work"
    command = ("city", "train", city, "-o", out, "--work", work, "--pools", pools, *TINY)

    def interrupt(self, epoch, done, total, losses):  # noqa: ARG001
        if epoch == 1:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Shown, "step", interrupt)
        result = run(*command)
    assert result.code == 130
    assert "Interrupted; 1 epoch is kept" in result.err
    assert f"placegraph city train {city}" in result.err
    assert not out.exists()
    gone_on = run(*command)
    assert gone_on.code == 0
    assert [line.split()[0] for line in gone_on.out.splitlines()[1:-1]] == ["2"]


def test_defaults_are_those_of_the_library():
    options = inspect.signature(city_train.train).parameters
    for name in ("epochs", "examples", "steps", "batch", "check", "rate", "seed"):
        assert options[name].default == getattr(TrainOptions(), name), name


def test_sizes_and_losses_are_those_of_the_library():
    options = inspect.signature(city_train.train).parameters
    for name in ("layers", "crossings", "heads", "statements"):
        assert options[name].default == getattr(TrainOptions().shape, name), name
    assert tuple(options["losses"].default.split(",")) == TrainOptions().losses


@pytest.mark.usefixtures("needs_torch")
def test_the_papers_network_is_trained_and_locates(run, city, pools, tmp_path):
    out = tmp_path / "paper.weights"
    made = run(
        "city", "train", city, "-o", out, "--work", tmp_path / "work", "--pools", pools, *TINY,
        "--losses", "eq17,eq18", "--no-statements", "--layers", 1, "--crossings", 1, "--heads", 2,
    )  # fmt: skip
    assert (made.code, made.err) == (0, "")
    assert made.out.split()[:3] == ["epoch", "eq17", "eq18"]
    shape = read_weights(out).shape
    assert (shape.layers, shape.crossings, shape.heads, shape.statements) == (1, 1, 2, False)
    found = run("city", "locate", city, TEXT, "--preset", "paper", "--weights", out, "--json")
    assert found.json["modes"]
    odd = run("city", "train", city, "-o", out, "--work", tmp_path / "odd", *TINY, "--heads", 5)
    assert (odd.code, "width 48 for 5 heads" in odd.err) == (7, True)


def test_what_cannot_be_trained_is_refused_at_once(run, city, tmp_path, monkeypatch):
    out, work = tmp_path / "a.weights", tmp_path / "work"
    train = ("city", "train", city)
    gone = run("city", "train", tmp_path / "gone.city", "-o", out, "--work", work)
    assert gone.code == 3
    nowhere = run(*train, "-o", tmp_path / "no" / "a.weights", "--work", work)
    assert nowhere.code == 4
    twice = run(*train, city, "-o", out, "--work", work)
    assert (twice.code, "Several maps are called town" in twice.err) == (7, True)
    assert run(*train, "-o", out, "--work", work, "--epochs", 0).code == 2
    assert not work.exists()
    monkeypatch.setitem(sys.modules, "torch", None)
    missing = run(*train, "-o", out, "--work", work)
    assert (missing.code, "placegraph[learn]" in missing.err) == (8, True)


@pytest.mark.usefixtures("needs_torch")
def test_another_training_and_a_strange_device_are_refused(run, city, pools, tmp_path):
    train = ("city", "train", city, "-o", tmp_path / "a.weights", "--work", tmp_path / "work")
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "plan.json").write_text("{}", "utf-8")
    other = run(*train, "--pools", pools, *TINY)
    assert (other.code, "another" in other.err) == (7, True)
    strange = run(*train, "--pools", pools, *TINY[:-1], "abacus")
    assert (strange.code, "choose cpu, cuda or auto" in strange.err) == (7, True)
    fast = run(*train, *TINY, "--rate", 50)
    assert (fast.code, "rate is 50" in fast.err) == (7, True)


# --- what weights are for ---


def test_locate_by_other_weights_and_matchers(run, city, weights):
    plain = run("city", "locate", city, TEXT, "--json", "--matcher", "relational").json
    assert plain["status"] == "OK"
    for matcher in ("fused", "transformer", "embedding"):
        for by in ("auto", "dense", "all"):
            found = run(
                "city", "locate", city, TEXT, "--json", "--weights", weights,
                "--matcher", matcher, "--candidates-by", by,
            )  # fmt: skip
            assert found.code == 0
            assert found.json["modes"]


def test_presets_and_what_overrides_them(run, city, weights):
    def modes(*options):
        found = run("city", "locate", city, TEXT, "--json", "--weights", weights, *options)
        assert found.code == 0, found.err
        return found.json["modes"]

    paper = modes("--preset", "paper")
    spelled = ("--matcher", "transformer", "--score", "cosine", "--candidates-by", "dense")
    assert modes(*spelled, "--candidates", 10) == paper
    assert modes("--preset", "paper", "--score", "logit") != paper
    few = modes("--preset", "paper", "--candidates", 2)
    assert len(few) == 2
    edits = modes("--preset", "paper", "--matcher", "edit-distance-plain", "--candidates", 2)
    assert len(edits) == 2
    lost = run("city", "locate", city, TEXT, "--score", "cosine")
    assert (lost.code, "the transformer alone has one" in lost.err) == (7, True)


def test_locate_asks_a_store_of_the_same_weights(run, city, weights, tmp_path):
    from placegraph.maps import open_map
    from placegraph.outdoor.network.encoded import EncodedCity
    from placegraph.outdoor.network.network import GraphTransformer

    network = GraphTransformer.open(weights)
    vectors = tmp_path / "town.vectors"
    EncodedCity(open_map(city), network).keep(vectors, name="town").close()
    locate = ("city", "locate", city, TEXT, "--json")
    found = run(*locate, "--weights", weights, "--store", vectors)
    assert found.code == 0
    direct = open_map(city).locate(TEXT, by="both", encoded=EncodedCity(open_map(city), network))
    assert found.json["modes"][0]["probability"] == pytest.approx(direct.best.probability, abs=1e-3)
    shipped = run(*locate, "--store", vectors)  # these vectors are of other weights
    assert (shipped.code, shipped.out) == (10, "")
    assert run(*locate, "--store", tmp_path / "gone.vectors").code == 3


def test_what_locate_does_not_know_is_refused(run, city, tmp_path):
    locate = ("city", "locate", city, TEXT)
    assert run(*locate, "--matcher", "luck").code == 7
    assert run(*locate, "--candidates-by", "magic").code == 7
    missing = run(*locate, "--weights", tmp_path / "gone.weights")
    assert (missing.code, "city train" in missing.err) == (3, True)
    assert run(*locate, "--weights", city).code == 4


def test_evaluate_by_a_matcher(run, city, tmp_path):
    row = {"id": "a", "text": TEXT, "longitude": 9.9918, "latitude": 53.5496}
    (tmp_path / "descriptions.jsonl").write_text(json.dumps(row), "utf-8")
    (tmp_path / "town.city").write_bytes(city.read_bytes())
    evaluate = ("city", "evaluate", tmp_path, "--json")
    relational, edit = (
        run(*evaluate, "--matcher", matcher) for matcher in ("relational", "embedding")
    )
    assert relational.code == edit.code == 0
    assert relational.json["within"] != edit.json["within"] or relational.json != edit.json
    assert run(*evaluate, "--matcher", "luck").code == 7
