from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.indoor.encode.labels import LabelsEncoder
from placegraph.indoor.library import SearchOptions
from placegraph.io.capture.frame import Capture, Frame
from placegraph_lab.tables.named.scene_retrieval import figures, report
from placegraph_lab.tables.runner import Journal
from placegraph_lab.tables.scene import search as retrieval
from placegraph_lab.tables.scene.places import (
    NOISY,
    THINGS,
    Place,
    Walk,
    encode_walk,
    noisy,
    replay,
)
from placegraph_lab.tables.scene.search import (
    ABSENT,
    Answer,
    Row,
    Scenes,
    Study,
    ask,
    recall,
    searcher,
)
from placegraph_lab.worlds.home.home import home, record, scene_of, visit


def _walk(seed, frames=10, changed=False):
    rng = np.random.default_rng(seed)
    flat = home(rng, style="hotel")
    interior = flat.furnish(rng)
    capture = record(interior, visit(flat, interior, rng, frames=frames), rng)
    name = f"home {seed}"
    return Place(name, scene_of(interior, name=name)), Walk(f"{name} same", name, capture, changed)


@pytest.fixture(scope="module")
def world():
    return [_walk(seed) for seed in range(4)]


@pytest.fixture(scope="module")
def scenes(world):
    made = Scenes([place for place, _ in world])
    made.know(LabelsEncoder())
    return made


def _paper_sums(encoder, vectors, capture):
    """Sum over frames of the mean over patches of the best cosine, scene by scene."""
    sums = []
    for nodes in vectors.values():
        total = 0.0
        for frame in capture:
            patches = encoder.patches(frame)
            flat = np.zeros((0, 1)) if patches is None else patches.reshape(-1, patches.shape[2])
            best = [max(float(p @ n) for n in nodes) for p in flat if p.any()]
            total += sum(best) / len(best) if best else 0.0
        sums.append(total)
    return sums


def test_the_papers_sum_is_that_of_the_paper(world, scenes):
    encoder = LabelsEncoder()
    vectors = {name: s.vectors[encoder.key] for name, s in scenes.signatures.items()}
    capture = world[1][1].capture
    by_hand = _paper_sums(encoder, vectors, capture)
    library = scenes.library(vectors, [encoder])
    told = library.search(capture, options=SearchOptions(method="cosines"))
    scores = {mode.scene: mode.score for mode in told.modes}
    assert np.allclose([scores[name] for name in vectors], by_hand, atol=1e-3)
    found = searcher(library, "paper").search(capture)
    assert np.allclose(found.scores, sorted(by_hand, reverse=True), atol=1e-3)
    assert found.names[0] == max(scores, key=scores.get)
    assert found.status == ""


def test_things_are_mistaken_for_the_same_as_long_as_they_are_in_view(world):
    camera = Camera(64, 36, 32.0, 32.0, 32.0, 18.0)
    names = {0: "sofa", 1: "table", 2: "plant", 3: "wall"}
    frames = []
    for t in range(12):
        ids = np.full((36, 64), 3)
        ids[:, 4 + t : 20 + t], ids[:, 30 + t : 44 + t] = 0, 1
        rgb, shown = np.zeros((36, 64, 3), np.uint8), {"labels": ids, "label_names": names}
        frames.append(Frame.from_arrays(rgb, camera, stamp=t, **shown))
    encoder, capture = LabelsEncoder(), Capture.from_frames(frames)
    wrong, alike = [], []
    for name in map(str, range(60)):
        walk = replace(world[0][1], name=name, capture=capture)
        made = noisy(encoder, THINGS, list(names.values()), walk)
        sofa = encoder.vector("sofa")
        said = [
            made.patches(f)[(encoder.patches(f) @ sofa) > 1 - 1e-5].mean(axis=0) for f in frames
        ]
        wrong.append(not np.allclose(said[0], sofa))
        alike.append(np.ptp(said, axis=0).max() < 1e-6)
    assert all(alike)
    assert 0.1 < np.mean(wrong) < 0.5


def test_truth_is_held_against_the_answer_only_afterwards(world, scenes):
    encoder = LabelsEncoder()
    walk = world[2][1]
    for method in retrieval.METHODS:
        all_, some = (scenes.library(n, [encoder]) for n in (scenes.names, scenes.names[:2]))
        answer = ask(searcher(all_, method), walk, "q", walk.capture)
        elsewhere = ask(searcher(some, method), walk, "q", walk.capture)
        assert answer.rank >= 1
        assert elsewhere.rank == 0
        assert elsewhere.right == 0.0
        assert answer.milliseconds > 0


def test_vectors_are_kept_and_replayed(tmp_path, world):
    walk = world[0][1]
    encoder = LabelsEncoder()
    words = sorted(walk.capture.label_names.values())
    known = encode_walk(walk, "labels", encoder, words, tmp_path)
    told = replay(encoder)
    for frame, old in zip(known.walk.capture, walk.capture, strict=True):
        assert np.array_equal(told.patches(frame), encoder.patches(old))
    assert known.seconds > 0
    files = list(tmp_path.rglob("*.npz"))
    again = encode_walk(walk, "labels", encoder, words, tmp_path)
    assert again.seconds == known.seconds
    assert list(tmp_path.rglob("*.npz")) == files
    with pytest.raises(OptionError, match="has not been encoded"):
        told.patches(walk.capture[0])
    other = encode_walk(walk, NOISY, encoder, words, tmp_path)
    differ = [
        (told.patches(a) != told.patches(b)).any(axis=2)[told.patches(a).any(axis=2)]
        for a, b in zip(known.walk.capture, other.walk.capture, strict=True)
    ]
    assert 0.2 < np.concatenate(differ).mean() < 0.4
    bare = replace(walk, name="bare", capture=record_without_labels(walk))
    assert encode_walk(bare, "labels", encoder, words, tmp_path) is None


def record_without_labels(walk):
    frames = [
        Frame.from_arrays(f.rgb(), f.camera, stamp=f.stamp, index=f.index)
        for f in walk.capture.frames[:2]
    ]
    return Capture.from_frames(frames)


@pytest.mark.all
def test_a_study_of_four_homes(tmp_path, world, monkeypatch):
    monkeypatch.setitem(retrieval.POOLS, "10", 2)
    monkeypatch.setitem(retrieval.POOLS, "50", 3)
    places, walks = [place for place, _ in world], [walk for _, walk in world]
    journal = Journal(tmp_path / "answers.jsonl")
    study = Study(places, walks, tmp_path, journal)
    row = study.row("labels")
    assert {key[2] for key in row.answers} == {1, 5, 10}
    assert len(row.answers["ours", "10", 10]) == 4
    assert recall(row.answers["ours", "50", 10], 1) >= 0.75
    assert all(a.rank == 0 for a in row.answers["ours", ABSENT, 10])
    assert row.kilobytes > 0.1
    count = len(journal)
    Study(places, walks, tmp_path, Journal(tmp_path / "answers.jsonl")).row("labels")
    assert len(Journal(tmp_path / "answers.jsonl")) == count  # nothing was asked again
    assert "labels, paper" in report([row])
    cells = figures([row])
    assert {c["method"] for c in cells} == {"paper", "ours"}
    assert all((c["status"] is None) == (c["method"] == "paper") for c in cells)
    both = study.row(f"{NOISY}, and appearance")
    assert len(both.answers["ours", "50", 10]) == 4
    noise = study.row(NOISY)
    assert {key[0] for key in noise.answers} == set(retrieval.METHODS)
    assert "without rarity" in report([noise])


def _answer(rank, status="OK", changed=False, probability=0.9, place="home 1"):
    return Answer("q", place, changed, 5, rank, 1, 0.5, probability, 0.1, status, 2.0)


def test_recall_and_tables_of_known_answers():
    answers = [_answer(1), _answer(2, "AMBIGUOUS"), _answer(4, "LOST"), _answer(0, changed=True)]
    assert [recall(answers, k) for k in (1, 3, 5)] == [0.25, 0.5, 0.75]
    assert np.isnan(recall([], 1))
    keys = (("paper", "50", 5), ("ours", "50", 5), ("ours", ABSENT, 5))
    row = Row("labels", dict.fromkeys(keys, answers), 1.0, 3.2, 30.0)
    text = report([row])
    line = next(t for t in text.splitlines() if t.startswith("| labels, ours"))
    assert ".25/.50/.75" in line
    assert "3.2" in line
    status = next(t for t in text.splitlines() if t.startswith("| labels  "))
    cells = [cell.strip() for cell in status.strip("|").split("|")]
    assert cells[2:6] == [".50", ".50", ".25", ".25"]
    months = text.split("Months later")[1]
    assert ".33/.00" in months
