"""Training on a drawn town: it learns, goes on where it was interrupted, and says what is wrong."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from placegraph.errors import InputError, MissingExtraError, OptionError
from placegraph.outdoor.network.network import GraphTransformer
from placegraph.outdoor.network.weights import Shape
from placegraph_learn.train.city.train import Progress, TrainOptions, train

pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")

OPTIONS = TrainOptions(
    epochs=2, examples=12, steps=4, batch=6, check=4, seed=7,
    shape=Shape(width=8, dimension=8, heads=2, layers=1, crossings=1, evidence=4),
)  # fmt: skip


WORDS = (b"museum", b"Bench", b"zwirbelei")

pytestmark = pytest.mark.usefixtures("one_thread")


class Interrupted(Exception):  # noqa: N818  # as KeyboardInterrupt is
    pass


class Stop(Progress):
    """Ends a training as Ctrl-C would."""

    def __init__(self, epoch, step):
        self.at = epoch, step

    def step(self, epoch, done, total, losses):  # noqa: ARG002
        if (epoch, done) == self.at:
            raise Interrupted


class Notes(Progress):
    def __init__(self):
        self.filled, self.steps, self.rows = [], [], []

    def filling(self, epoch, city, done, total):
        self.filled.append((epoch, city, done, total))

    def step(self, epoch, done, total, losses):
        self.steps.append((epoch, done, total, dict(losses)))

    def epoch(self, row):
        self.rows.append(dict(row))


@pytest.fixture(scope="module")
def learn(harbour, vocabulary, tmp_path_factory):
    """Train in a folder; examples are shared by all."""
    pools = tmp_path_factory.mktemp("pools")

    def call(folder, options=OPTIONS, **more):
        more = {"pools": pools, "device": "cpu", "vocabulary": vocabulary} | more
        folder.mkdir(exist_ok=True)
        return train(
            {"town": harbour}, folder / "a.weights", folder=folder, options=options, **more
        )

    return call


@pytest.fixture(scope="module")
def trained(learn, tmp_path_factory):
    folder, notes = tmp_path_factory.mktemp("trained"), Notes()
    return learn(folder, progress=notes), folder, notes


def test_what_is_written_is_what_is_returned(trained):
    weights, folder, _ = trained
    network = GraphTransformer.open(folder / "a.weights")
    assert network.fingerprint == weights.fingerprint
    assert network.shape == OPTIONS.shape
    assert weights.training["plan"]["options"]["seed"] == 7
    assert [row["epoch"] for row in weights.training["curves"]] == [1, 2]


def test_progress_is_told(trained):
    _, folder, notes = trained
    assert [(e, d, t) for e, d, t, _ in notes.steps] == [
        (e, d, 4) for e in (0, 1) for d in (1, 2, 3, 4)
    ]
    assert {"match", "similarity", "embedding", "fusion"} == notes.steps[0][3].keys()
    assert {row["epoch"] for row in notes.rows} == {1, 2}
    assert {"relational", "network", "dense", "fused"} <= notes.rows[0].keys()
    curves = (folder / "curves.jsonl").read_text("utf-8").splitlines()
    assert [json.loads(line) for line in curves] == notes.rows


@pytest.mark.parametrize("at", [(0, 3), (1, 2)])
def test_an_interrupted_training_goes_on_as_if_never_interrupted(learn, trained, tmp_path, at):
    with pytest.raises(Interrupted):
        learn(tmp_path / "b", progress=Stop(*at))
    assert not (tmp_path / "b" / "a.weights").exists()
    weights = learn(tmp_path / "b")
    assert weights.fingerprint == trained[0].fingerprint
    for name, array in trained[0].arrays.items():
        assert np.array_equal(weights.arrays[name], array), name
    assert weights.training == trained[0].training


def test_a_finished_training_is_only_written_again(learn, trained):
    weights, folder, _ = trained
    notes = Notes()
    assert learn(folder, progress=notes).fingerprint == weights.fingerprint
    assert not notes.steps
    assert not notes.filled  # examples are kept as well


@pytest.mark.parametrize("losses", [("match",), ("embedding",), ("eq17", "eq18")])
def test_each_loss_alone_trains(learn, tmp_path, losses):
    notes = Notes()
    learn(tmp_path / "b", replace(OPTIONS, losses=losses, epochs=1), progress=notes)
    assert notes.steps[-1][3].keys() == set(losses)


def test_several_seeds_share_descriptions(learn, trained, tmp_path):
    notes = Notes()
    other = replace(OPTIONS, seed=OPTIONS.seed + 1, descriptions=OPTIONS.seed)
    weights = learn(tmp_path / "b", other, progress=notes)
    assert not notes.filled
    assert weights.fingerprint != trained[0].fingerprint


def test_the_loss_falls(learn, tmp_path):
    options = replace(OPTIONS, epochs=1, steps=80, rate=1e-2)
    notes = Notes()
    learn(tmp_path / "b", options, progress=notes)
    told = [sum(losses.values()) for *_, losses in notes.steps]  # means of the epoch so far
    last = (80 * told[79] - 70 * told[69]) / 10
    assert last < 0.9 * told[4]


def test_word_vectors_of_a_file_are_trained_with(learn, tmp_path, harbour):
    """Those of the map's words are kept: nothing else is needed to read the weights."""
    rng, file = np.random.default_rng(2), tmp_path / "words.bin"

    def write():
        blocks = [w + b" " + rng.normal(size=300).astype("<f4").tobytes() for w in WORDS]
        file.write_bytes(b"%d 300\n" % len(WORDS) + b"".join(blocks))

    write()
    options = replace(OPTIONS, epochs=1, word_vectors=str(file))
    notes = Notes()
    weights = learn(tmp_path / "b", options, progress=notes)
    assert weights.words.words == ("bench", "museum")
    assert weights.arrays["meaning.weight"].shape == (8, 300)
    assert all(np.isfinite(loss) for *_, losses in notes.steps for loss in losses.values())
    network = GraphTransformer.open(tmp_path / "b" / "a.weights")
    assert network.fingerprint == weights.fingerprint
    assert "tourism=museum" in harbour.words
    bags = network.bags(harbour.words)
    assert bags.means[harbour.words.index("tourism=museum")].any()
    write()  # other numbers under the same name
    with pytest.raises(OptionError, match="other maps or options"):
        learn(tmp_path / "b", options)
    file.unlink()
    with pytest.raises(InputError, match="name a word2vec file"):
        learn(tmp_path / "b", options)


def test_a_folder_of_another_training_is_refused(learn, trained, tmp_path):
    _, folder, _ = trained
    for other in (replace(OPTIONS, rate=1.0), replace(OPTIONS, shape=Shape(width=12))):
        with pytest.raises(OptionError, match="holds a training with other maps or options"):
            learn(folder, other)
    (tmp_path / "plan.json").write_text("{", "utf-8")
    with pytest.raises(InputError, match="no folder to train in"):
        learn(tmp_path)
    (tmp_path / "file").write_text("", "utf-8")
    with pytest.raises(InputError, match="no folder for examples"):
        learn(tmp_path / "b", pools=tmp_path / "file")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"epochs": 0}, "epochs is 0"),
        ({"examples": 0}, "examples is 0"),
        ({"check": -1}, "check is -1"),
        ({"losses": ()}, "choose among match"),
        ({"losses": ("match", "luck")}, "choose among match"),
        ({"shape": Shape(width=12, heads=5)}, "width 12 for 5 heads"),
    ],
)
def test_options_out_of_range_are_refused(learn, tmp_path, changes, says):
    with pytest.raises(OptionError, match=says):
        learn(tmp_path / "b", replace(OPTIONS, **changes))


def test_no_city_is_refused(tmp_path):
    with pytest.raises(OptionError, match="name at least one map"):
        train({}, tmp_path / "a.weights", folder=tmp_path)


def test_without_torch_it_says_what_to_install(learn, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[learn\]"):
        learn(tmp_path / "b")


def test_the_core_never_imports_torch():
    import subprocess

    code = (
        "import sys, importlib, pkgutil, placegraph.outdoor as o\n"
        "import placegraph_learn.train.city.train, placegraph.outdoor.search.cells, placegraph.cli\n"
        "import placegraph.outdoor.network.encoded, placegraph_learn.train.city.sample\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)  # noqa: S603


# --- what a folder keeps ---


def test_pools_come_back_as_they_were_kept(pool, tmp_path):
    from placegraph_learn.train.city.checkpoint import PoolFolder

    folder = PoolFolder(tmp_path / "pools")
    assert folder.read("a") is None
    folder.write("a", pool)
    found = folder.read("a")
    for part in ("texts", "fits"):
        ours, theirs = getattr(pool, part), getattr(found, part)
        for name in type(ours).__annotations__:
            a, b = getattr(ours, name), getattr(theirs, name)
            assert np.array_equal(a, b) if name != "vocabulary" else a == b
            assert name == "vocabulary" or a.dtype == b.dtype
    for name in ("positions", "views", "right"):
        assert np.array_equal(getattr(pool, name), getattr(found, name))
    assert np.array_equal(pool.scores, found.scores, equal_nan=True)


def test_a_drawn_batch_has_something_right_for_every_text(harbour, pool, rng):
    from placegraph_learn.train.city.torch_batches import Lessons

    lessons = Lessons(harbour, pool)
    rows, chosen = lessons.draw(8, 0.3, rng)
    assert len(set(rows.tolist())) == 8
    right = lessons.right[rows] == 1
    assert ((right & chosen).any(axis=1) == right.any(axis=1)).all()
    batch = lessons.batch(rows, chosen)
    off = harbour.views.positions[pool.views[rows][batch.pairs.text, batch.slots]]
    for p in range(len(batch.right)):
        for q in range(8):
            delta = np.abs(off[p] - pool.positions[rows[q]]).max()
            assert batch.everywhere[q, p] == (1 if delta <= 25 else -1 if delta <= 60 else 0)
        if batch.right[p] >= 0:
            assert batch.right[p] == batch.everywhere[batch.pairs.text[p], p]


def test_right_places_stand_beside_wrong_ones_only_where_matching_likes_them(harbour, pool):
    """Wrong ones are chosen for being liked: right ones that are not would teach to contradict."""
    from placegraph.outdoor.search.rerank import HARD
    from placegraph_learn.train.city.torch_batches import Lessons

    right = Lessons(harbour, pool).right
    assert np.array_equal(right[pool.right != 1], pool.right[pool.right != 1])
    assert np.isfinite(pool.scores[right == 1]).all()
    for q in range(len(pool)):
        known = np.sort(pool.scores[q][np.isfinite(pool.scores[q])])[::-1]
        least = known[:HARD].min()
        assert (pool.scores[q][right[q] == 1] >= least).all()
        silenced = (pool.right[q] == 1) & (right[q] == -1)
        assert not (pool.scores[q][silenced] > least).any()
    assert (right == 1).any(axis=1).mean() > 0.5
