import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import placegraph as pg
from placegraph.core.graph import SceneGraph
from placegraph.errors import DescriptionError, OptionError
from placegraph.indoor.language import TextIndex, rank_scenes, read, score


def graph(*labels, edges=()):
    """Scene graph of things; edges are (row, relation, row)."""
    return SceneGraph(
        ids=tuple(map(str, range(len(labels)))),
        labels=labels,
        positions=np.zeros((len(labels), 3)),
        sources=np.array([s for s, _, _ in edges], np.int64),
        relations=tuple(r for _, r, _ in edges),
        targets=np.array([t for _, _, t in edges], np.int64),
    )


KITCHEN = graph("sink", "stove", "fridge", "table", "chair", "chair", "sink")
ONE_SINK = graph("sink", "stove", "fridge", "table", "chair", "chair")
BEDROOM = graph("bed", "nightstand", "wardrobe", "lamp", "chair")
BATHROOM = graph("toilet", "sink", "bathtub", "mirror")
LIVING = graph("sofa", "television", "coffee table", "plant", edges=[(3, "standing on", 2)])
LOUNGE = graph("sofa", "television", "coffee table", "plant", edges=[(3, "next to", 0)])
SCENES = [KITCHEN, ONE_SINK, BEDROOM, BATHROOM, LIVING, LOUNGE]


@pytest.mark.parametrize(
    ("text", "best"),
    [
        ("a kitchen with two sinks", KITCHEN), ("a kitchen with one sink", ONE_SINK),
        ("a kitchen", KITCHEN), ("a bedroom", BEDROOM), ("a bathroom", BATHROOM),
        ("a plant on the table", LIVING), ("the plant is beside the sofa", LOUNGE),
        ("a couch and a tv, with a plant on the coffee table", LIVING),
        ("chairs but no table", BEDROOM), ("there is a sink and no stove", BATHROOM),
        ("a night stand", BEDROOM),
    ],
)  # fmt: skip
def test_the_scene_that_is_meant_is_first(text, best):
    assert SCENES[TextIndex(SCENES).search(read(text), 1)[0][0]] is best


def test_words_of_a_kind_fit_at_a_discount():
    said = read("a sofa")
    sofa, couch, chair, desk = rank_scenes(
        said, [graph(x) for x in ("sofa", "couch", "armchair", "desk")]
    )
    assert sofa >= couch > chair >= desk


def test_what_is_rare_counts_more():
    scenes = [graph("chair", "lamp"), *[graph("chair", "table")] * 8, graph("lamp", "harp")]
    said = read("a chair and a harp")
    scores = rank_scenes(said, scenes)
    assert scores[-1] > scores[:-1].max()
    lone = scenes[-1].subgraph([1])
    rare, common = lone, graph("chair")
    library = TextIndex(scenes)
    weight = [e.weight for e in score(said, rare, library=library).evidence]
    other = [e.weight for e in score(said, common, library=library).evidence]
    assert weight[1] > other[0] > 0 > weight[0]


def test_scenes_are_ranked_by_a_text():
    ratios = pg.rank_scenes("a kitchen with two sinks", iter(SCENES))
    assert ratios.shape == (len(SCENES),)
    assert ratios.argmax() == SCENES.index(KITCHEN)
    assert ratios[0] > 0 > ratios[2]
    alone = TextIndex(SCENES).scores(read("a kitchen with two sinks"))
    np.testing.assert_array_equal(ratios, alone)
    with pytest.raises(DescriptionError):
        pg.rank_scenes(" ", SCENES)


def test_evidence_names_what_it_is_about():
    found = score(read("a kitchen with two sinks and a bed"), KITCHEN)
    room, sinks, bed = found.evidence
    assert (room.verdict, sinks.verdict, bed.verdict) == ("for", "for", "against")
    assert [o.id for o in sinks.objects] == ["0", "6"]
    assert sinks.statement == "two sinks"
    assert found.log_likelihood == pytest.approx(sum(e.weight for e in found.evidence))


def test_rooms_of_a_home_are_described_one_by_one():
    home = graph("bed", "lamp", "sink", "stove", "fridge", "toilet", "sink", "mirror")
    rooms = ["bedroom"] * 2 + ["kitchen"] * 3 + ["bathroom"] * 3
    two_sinks = read("a kitchen with two sinks")
    assert score(two_sinks, home, rooms).log_likelihood < score(two_sinks, KITCHEN).log_likelihood
    numbers = ["1"] * 2 + ["2"] * 3 + ["3"] * 3
    for names in (rooms, numbers):
        yes, no = read("a bedroom with a lamp"), read("a bathroom with a lamp")
        assert score(yes, home, names).log_likelihood > score(no, home, names).log_likelihood + 1.0
    told = graph(*home.labels, edges=[(0, "same room", 1), (2, "same room", 3), (3, "same room", 4),
                                      (5, "same room", 6), (6, "same room", 7)])  # fmt: skip
    assert rank_scenes(two_sinks, [told]) == pytest.approx(
        rank_scenes(two_sinks, [home], [numbers])
    )
    assert score(read("two bathrooms"), home, rooms).log_likelihood < 0.5


def test_rooms_are_named_one_an_object():
    with pytest.raises(OptionError, match="1 values for 7 objects"):
        score(read("a sofa"), KITCHEN, ["kitchen"])


def test_an_empty_index_and_an_empty_sentence():
    assert TextIndex().scores(read("a sofa")).shape == (0,)
    assert TextIndex().search(read("a sofa")) == []
    assert (rank_scenes(read("so what"), SCENES) == 0).all()
    assert score(read("so what"), KITCHEN).log_likelihood == 0.0
    with pytest.raises(OptionError, match="index has 6"):
        TextIndex(SCENES).remove(6)
    bare = rank_scenes(read("a kitchen with a sofa and no harp"), [graph(), KITCHEN])
    assert np.isfinite(bare).all()


LABELS = ["sofa", "couch", "chair", "table", "desk", "sink", "bed", "stove", "lamp", "plant"]
RELATIONS = ["standing on", "next to", "same room", "above", "supported by", "left"]
graphs = st.builds(
    lambda labels, edges: graph(
        *labels, edges=[(s % len(labels), r, t % len(labels)) for s, r, t in edges if labels]
    ),
    st.lists(st.sampled_from(LABELS), max_size=8),
    st.lists(
        st.tuples(st.integers(0, 7), st.sampled_from(RELATIONS), st.integers(0, 7)), max_size=8
    ),
)
texts = st.sampled_from([
    "a kitchen with two sinks and a plant on the table", "a bedroom without a desk",
    "three chairs around a table, no sofa", "lamp under the desk, a bed left of the couch",
    "I am next to the sofa, facing the stove", "a lamp with some chairs",
])  # fmt: skip


@settings(max_examples=25)
@given(st.lists(graphs, min_size=1, max_size=6), texts)
def test_the_index_says_what_single_scenes_say(scenes, text):
    said, index = read(text), TextIndex(scenes)
    alone = [score(said, scene, library=index).log_likelihood for scene in scenes]
    assert index.scores(said) == pytest.approx(alone, abs=1e-5)


@settings(max_examples=25)
@given(st.lists(graphs, min_size=2, max_size=6), texts, st.data())
def test_scenes_come_and_go(scenes, text, data):
    said, index = read(text), TextIndex(scenes)
    row = data.draw(st.integers(0, len(scenes) - 1))
    index.scores(said)
    index.remove(row)
    left = [*scenes[:row], *scenes[row + 1 :]]
    assert index.scores(said) == pytest.approx(rank_scenes(said, left))
    assert index.add(scenes[row]) == len(left)
    assert index.scores(said) == pytest.approx(rank_scenes(said, [*left, scenes[row]]))
    assert len(index) == len(scenes)
