import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from placegraph.errors import InputError, OptionError
from placegraph.outdoor.network.network import GraphTransformer
from placegraph.outdoor.network.weights import Shape
from placegraph.outdoor.search.posterior import NUM_RERANKED
from placegraph_learn.city.batches import Lessons
from placegraph_learn.city.network import Network
from placegraph_learn.city.train import (
    LOSSES,
    Scores,
    Temperatures,
    TrainOptions,
    Truth,
    ViewpointScores,
    contrastive,
    losses,
    mean_recalls,
    read_pool,
    recall,
    score_viewpoints,
    train,
    write_pool,
)

OPTIONS = TrainOptions(
    epochs=2, examples=8, steps=3, batch=4, check=4, seed=7,
    shape=Shape(width=8, dimension=8, heads=2, layers=1, crossings=1, evidence=4),
)  # fmt: skip


WORDS = (b"museum", b"Bench", b"zwirbelei")


@pytest.fixture(scope="module")
def learn(harbour, vocabulary, tmp_path_factory):
    pools = tmp_path_factory.mktemp("pools")

    def call(folder, options=OPTIONS, **more):
        more = {"pools": pools, "device": "cpu", "vocabulary": vocabulary} | more
        folder.mkdir(exist_ok=True)
        return train(
            {"town": harbour}, folder / "a.weights", folder=folder, options=options, **more
        )

    return call


@pytest.fixture(scope="module")
def trained(learn, tmp_path_factory, make_notes):
    folder, notes = tmp_path_factory.mktemp("trained"), make_notes()
    return learn(folder, progress=notes), folder, notes


def test_what_is_written_is_what_is_returned(trained):
    weights, folder, _ = trained
    network = GraphTransformer.open(folder / "a.weights")
    assert network.digest == weights.digest
    assert network.shape == OPTIONS.shape
    assert weights.training["plan"]["options"]["seed"] == 7
    assert [row["epoch"] for row in weights.training["curves"]] == [1, 2]


def test_progress_is_told(trained):
    _, folder, notes = trained
    assert [(e, d, t) for e, d, t, _ in notes.steps] == [
        (e, d, 3) for e in (0, 1) for d in (1, 2, 3)
    ]
    assert {"match", "similarity", "embedding", "fusion"} == notes.steps[0][3].keys()
    assert {row["epoch"] for row in notes.rows} == {1, 2}
    assert {"relational", "network", "dense", "fused"} <= notes.rows[0].keys()
    curves = (folder / "curves.jsonl").read_text("utf-8").splitlines()
    assert [json.loads(line) for line in curves] == notes.rows


@pytest.mark.parametrize("stop", [(1, 2), pytest.param((0, 3), marks=pytest.mark.all)])
def test_an_interrupted_training_goes_on_as_if_never_interrupted(
    learn, trained, tmp_path, make_notes, stop
):
    with pytest.raises(KeyboardInterrupt):
        learn(tmp_path / "b", progress=make_notes(stop))
    assert not (tmp_path / "b" / "a.weights").exists()
    weights = learn(tmp_path / "b")
    assert weights.digest == trained[0].digest
    assert weights.training == trained[0].training


def test_a_finished_training_is_only_written_again(learn, trained, make_notes):
    weights, folder, _ = trained
    notes = make_notes()
    assert learn(folder, progress=notes).digest == weights.digest
    assert not notes.steps
    assert not notes.filled  # examples are kept as well


def test_several_seeds_share_descriptions(learn, trained, tmp_path, make_notes):
    notes = make_notes()
    other = replace(OPTIONS, seed=OPTIONS.seed + 1, descriptions=OPTIONS.seed)
    weights = learn(tmp_path / "b", other, progress=notes)
    assert not notes.filled
    assert weights.digest != trained[0].digest


PRINTED = replace(
    OPTIONS,
    losses=("eq17", "eq18"),
    shape=Shape(width=8, dimension=8, heads=2, layers=1, crossings=1, printed=True),
)


def test_the_network_as_printed_learns_cells_with_word_vectors(learn, tmp_path, make_notes):
    file, rng = tmp_path / "words.bin", np.random.default_rng(2)
    blocks = [w + b" " + rng.normal(size=300).astype("<f4").tobytes() for w in WORDS]
    file.write_bytes(b"%d 300\n" % len(WORDS) + b"".join(blocks))
    options = replace(PRINTED, epochs=2, steps=12, rate=1e-2, word_vectors=str(file))
    notes = make_notes()
    weights = learn(tmp_path / "a", options, progress=notes)
    assert weights.words.words == ("bench", "museum")
    assert notes.rows[0].keys() == {"epoch", "eq17", "eq18", "dense", "network"}
    first, last = (sum(row[name] for name in ("eq17", "eq18")) for row in notes.rows)
    assert last < first
    network = GraphTransformer.open(tmp_path / "a" / "a.weights")
    bench = network.word_vectors(("bench", "bicycle parking"))
    means = weights.words.vectors[0] @ network.arrays["meaning.weight"].T
    assert bench[0] == pytest.approx(means, rel=1e-4, abs=1e-5)
    assert bench[1].any()  # hashed subwords stand for other labels


def test_word_vectors_of_a_file_are_trained_with(learn, tmp_path, harbour, make_notes):
    rng, file = np.random.default_rng(2), tmp_path / "words.bin"

    def write():
        blocks = [w + b" " + rng.normal(size=300).astype("<f4").tobytes() for w in WORDS]
        file.write_bytes(b"%d 300\n" % len(WORDS) + b"".join(blocks))

    write()
    options = replace(OPTIONS, epochs=1, word_vectors=str(file))
    notes = make_notes()
    weights = learn(tmp_path / "b", options, progress=notes)
    assert weights.words.words == ("bench", "museum")
    assert weights.arrays["meaning.weight"].shape == (8, 300)
    assert all(np.isfinite(loss) for *_, losses in notes.steps for loss in losses.values())
    network = GraphTransformer.open(tmp_path / "b" / "a.weights")
    assert network.digest == weights.digest
    assert "tourism=museum" in harbour.words
    bags = network.bags(harbour.words)
    assert bags.means[harbour.words.index("tourism=museum")].any()
    write()  # other numbers under the same name
    with pytest.raises(OptionError, match="other maps or options"):
        learn(tmp_path / "b", options)
    file.unlink()
    with pytest.raises(InputError, match="give a word2vec file"):
        learn(tmp_path / "b", options)


def test_a_folder_of_another_training_is_refused(learn, trained, tmp_path):
    _, folder, _ = trained
    for other in (replace(OPTIONS, rate=1.0), replace(OPTIONS, shape=Shape(width=12))):
        with pytest.raises(OptionError, match="contains a training with other maps or options"):
            learn(folder, other)
    (tmp_path / "plan.json").write_text("{", "utf-8")
    with pytest.raises(InputError, match="cannot be used as the folder of a training"):
        learn(tmp_path)
    (tmp_path / "file").write_text("", "utf-8")
    with pytest.raises(InputError, match="cannot be used as a folder for examples"):
        learn(tmp_path / "b", pools=tmp_path / "file")
    with pytest.raises(OptionError, match="name at least one"):
        train({}, tmp_path / "a.weights", folder=tmp_path)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"epochs": 0}, "epochs is 0"),
        ({"examples": 0}, "examples is 0"),
        ({"check": -1}, "check is -1"),
        ({"losses": ()}, "losses is empty"),
        ({"losses": ("match", "luck")}, "each 'match' or"),
    ],
)
def test_options_out_of_range_are_refused(learn, tmp_path, changes, says):
    with pytest.raises(OptionError, match=says):
        learn(tmp_path / "b", replace(OPTIONS, **changes))


def test_pools_come_back_as_they_were_kept(pool, tmp_path):
    write_pool(tmp_path / "a.pool", pool)
    found = read_pool(tmp_path / "a.pool")
    for part in ("texts", "word_weights"):
        ours, theirs = getattr(pool, part), getattr(found, part)
        for name in type(ours).__annotations__:
            a, b = getattr(ours, name), getattr(theirs, name)
            assert np.array_equal(a, b) if name != "vocabulary" else a == b
            assert name == "vocabulary" or a.dtype == b.dtype
    for name in ("positions", "views", "right"):
        assert np.array_equal(getattr(pool, name), getattr(found, name))
    assert np.array_equal(pool.scores, found.scores, equal_nan=True)


def test_a_drawn_batch_has_something_right_for_every_text(harbour, pool, rng):

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
    right = Lessons(harbour, pool).right
    assert np.array_equal(right[pool.right != 1], pool.right[pool.right != 1])
    assert np.isfinite(pool.scores[right == 1]).all()
    for q in range(len(pool)):
        known = np.sort(pool.scores[q][np.isfinite(pool.scores[q])])[::-1]
        least = known[:NUM_RERANKED].min()
        assert (pool.scores[q][right[q] == 1] >= least).all()
        silenced = (pool.right[q] == 1) & (right[q] == -1)
        assert not (pool.scores[q][silenced] > least).any()
    assert (right == 1).any(axis=1).mean() > 0.5


def tensor(numbers):
    return torch.tensor(numbers, dtype=torch.float32)


def scales(value=0.0):
    return Temperatures(tensor([value]), tensor([value]), tensor(1.0))


@pytest.mark.parametrize(
    ("right", "share"),
    [
        ([[1, 0, 0]], lambda e: e[0] / e.sum()),
        ([[1, 1, 0]], lambda e: (e[0] + e[1]) / e.sum()),
        ([[1, -1, 0]], lambda e: e[0] / (e[0] + e[2])),  # what is near does not count
        ([[1, 0, 0], [1, -1, -1], [0, 0, 0]], lambda e: e[0] / e.sum()),  # nothing to tell apart
        ([[1, -1, -1]], lambda _: 1.0),
    ],
)
def test_contrastive_is_minus_log_share_of_what_is_right(right, share):
    scores = tensor([[1.0, 2.0, 0.5]]).repeat(len(right), 1).requires_grad_()
    right = torch.tensor(right)
    loss = contrastive(scores, right)
    expected = -np.log(share(np.exp([1.0, 2.0, 0.5])))
    assert float(loss.detach()) == pytest.approx(expected, abs=1e-6)
    loss.backward()
    assert not scores.grad[right == -1].any()


@pytest.fixture
def two_texts():
    """Text 0 has places 0, 1, text 1 places 2, 3; place 3 is near, and place 2 right for both."""
    scores = Scores(
        tensor([2.0, -1.0, 0.5, 4.0]),
        tensor([0.9, 0.1, 0.3, 0.8]),
        tensor([[0.9, 0.1, 0.2, 0.0], [0.4, 0.3, 0.6, 0.9]]),
        tensor([1.0, 2.0, 0.0, 0.0]),
    )
    everywhere = torch.tensor([[1, 0, 1, 0], [0, 0, 1, -1]])
    relational = tensor([3.0, 1.5, np.nan, 2.0])
    return scores, Truth(
        torch.tensor([0, 0, 1, 1]), torch.tensor([1, 0, 1, -1]), everywhere, relational
    )


def test_losses_by_hand(two_texts):
    found = losses(*two_texts, scales(1.0))
    assert found.keys() == set(LOSSES)
    for name in LOSSES:
        assert losses(*two_texts, scales(1.0), [name]) == {name: found[name]}

    def sigmoid(x):
        return 1.0 / (1.0 + np.exp(-x))

    binary = -np.log([sigmoid(2.0), 1.0 - sigmoid(-1.0), sigmoid(0.5)]).mean()
    e = np.exp([2.0, -1.0])
    # of text 1 nothing is wrong: only text 0 ranks
    assert float(found["match"]) == pytest.approx(binary - np.log(e[0] / e.sum()))
    e = np.exp(np.e * np.array([0.9, 0.1]))
    assert float(found["similarity"]) == pytest.approx(-np.log(e[0] / e.sum()), rel=1e-5)
    e = np.exp([3.0 + 1.0, 1.5 + 2.0])
    assert float(found["fusion"]) == pytest.approx(-np.log(e[0] / e.sum()), rel=1e-5)
    first, second = (np.exp(np.e * np.array(x)) for x in ([0.9, 0.2, 0.1, 0.0], [0.6, 0.4, 0.3]))
    expected = -np.log([first[:2].sum() / first.sum(), second[0] / second.sum()]).mean()
    assert float(found["embedding"]) == pytest.approx(expected, rel=1e-5)


def test_losses_as_printed_by_hand(two_texts):
    """Eq. 17: cross-entropy of the probability. Eq. 18: wrong cosines, and what right ones lack."""
    found = losses(*two_texts, scales(), ("eq17", "eq18"))
    assert list(found) == ["eq17", "eq18"]
    p = 1.0 / (1.0 + np.exp([-2.0, 1.0, -0.5]))
    assert float(found["eq17"]) == pytest.approx(-np.log([p[0], 1 - p[1], p[2]]).mean())
    assert float(found["eq18"]) == pytest.approx(0.1 + ((1 - 0.9) + (1 - 0.3)) / 2)


def test_what_relational_matching_never_scored_is_not_fused(two_texts):
    scores, truth = two_texts
    before = float(losses(scores, truth, scales(), ["fusion"])["fusion"])
    loud = scores._replace(residual=scores.residual + tensor([0.0, 0.0, 50.0, 0.0]))
    assert float(losses(loud, truth, scales(), ["fusion"])["fusion"]) == pytest.approx(before)
    twice = scales()._replace(relational=tensor(2.0))
    e = np.exp([6.0 + 1.0, 3.0 + 2.0])
    found = losses(scores, truth, twice, ["fusion"])["fusion"]
    assert float(found) == pytest.approx(-np.log(e[0] / e.sum()), rel=1e-5)


def judged(relational, logit, cosine, fused, near):
    near = np.array(near, bool)
    apart = np.broadcast_to(np.eye(near.shape[1], dtype=bool), (len(near), *[near.shape[1]] * 2))
    scores = (np.array(x, np.float64) for x in (relational, logit, cosine, fused))
    return ViewpointScores(*scores, near, apart)


def test_places_close_together_share_their_probability():
    scores = np.log([[0.4, 0.3, 0.3]])
    near = [[False, True, True]]
    side_by_side = np.eye(3, dtype=bool)[None] | np.array([[[0, 0, 0], [0, 0, 1], [0, 1, 0]]], bool)
    apart = judged(*[scores] * 4, near)
    assert recall(scores, apart) == 0.0
    assert recall(scores, apart._replace(together=side_by_side)) == 1.0


def test_each_matcher_is_counted_and_cities_count_alike():
    first, second = [0.0, 9.0], [9.0, 0.0]
    near = [[True, False]]
    one = judged([second], [first], [first], [second], near)
    other = judged([second], [second], [first], [second], near)
    many = judged(*(np.repeat(x, 5, axis=0) for x in other[:5]))
    expected = {"relational": 1.0, "network": 0.5, "dense": 0.0, "fused": 1.0}
    assert mean_recalls([one, many]) == expected
    no = -np.inf  # what was not asked is not found
    asked = judged([[1.0, no]], [[1.0, no]], [[0.1, no]], [[1.0, no]], [[True, False]])
    assert set(mean_recalls([asked]).values()) == {1.0}


def test_what_is_judged_are_the_best_of_relational_matching(harbour, pool, network):

    module = Network(network.shape)
    module.load_state_dict({n: torch.from_numpy(a) for n, a in network.arrays.items()})
    found = score_viewpoints(module, Lessons(harbour, pool), "cpu")
    asked = np.isfinite(found.relational)
    assert asked.sum(axis=1).max() <= NUM_RERANKED
    for scores in (found.logit, found.cosine, found.fused):
        assert np.array_equal(np.isfinite(scores), asked)
    assert (pool.views[asked] >= 0).all()
    least = np.where(asked, found.relational, np.inf).min(axis=1)
    left_out = np.isfinite(pool.scores) & ~asked
    assert (np.where(left_out, pool.scores, -np.inf).max(axis=1) <= least + 1e-6).all()
    off = np.hypot(
        *(harbour.views.positions[pool.views] - pool.positions[:, None]).transpose(2, 0, 1)
    )
    assert np.array_equal(found.near, (off <= 50.0) & asked)


def test_training_begins_with_relational_matching(harbour, pool, network):
    found = score_viewpoints(Network(network.shape), Lessons(harbour, pool), "cpu")
    asked = np.isfinite(found.relational)
    added = found.fused[asked] - found.relational[asked]
    of = np.nonzero(asked)[0]
    first = added[np.searchsorted(of, of)]
    assert added == pytest.approx(first, abs=1e-4)  # the same for all places of a text
    told = mean_recalls([found])
    assert told["fused"] == told["relational"]
