import json

import numpy as np
import pytest

from placegraph.maps import open_map
from placegraph.outdoor.network.network import EncodedCity, GraphTransformer
from placegraph.outdoor.network.weights import Shape, round_weights, write_weights

TEXT = "I am on Speicherweg. The museum is south of me."


@pytest.fixture
def city(harbour_file):
    return harbour_file


@pytest.fixture
def weights(tmp_path):
    shape, rng = Shape(width=8, dimension=8, heads=2, evidence=4), np.random.default_rng(3)
    state = {name: rng.normal(scale=0.3, size=size) for name, size in shape.arrays().items()}
    write_weights(tmp_path / "a.weights", round_weights(shape, state, {}))
    return tmp_path / "a.weights"


def test_locate_by_other_weights_and_matchers(run, city, weights):
    plain = run("city", "locate", city, TEXT, "--json", "--matcher", "relational").json
    assert plain["status"] == "OK"
    for matcher in ("fused", "transformer", "embedding"):
        for by in ("auto", "dense", "all"):
            options = ("--weights", weights, "--matcher", matcher, "--candidates-by", by)
            found = run("city", "locate", city, TEXT, "--json", *options)
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
    assert (lost.code, "applies only to the transformer" in lost.err) == (7, True)


def test_locate_asks_a_store_of_the_same_weights(run, city, weights, tmp_path):
    network = GraphTransformer.open(weights)
    vectors = tmp_path / "town.vectors"
    EncodedCity(open_map(city), network).save_embeddings(vectors, name="town").close()
    locate = ("city", "locate", city, TEXT, "--json")
    found = run(*locate, "--weights", weights, "--store", vectors)
    assert found.code == 0
    direct = open_map(city).locate(TEXT, by="both", encoded=EncodedCity(open_map(city), network))
    assert found.json["modes"][0]["probability"] == pytest.approx(direct.best.probability, abs=1e-3)
    shipped = run(*locate, "--store", vectors)  # these vectors are of other weights
    assert (shipped.code, shipped.out) == (10, "")
    assert run(*locate, "--store", tmp_path / "gone.vectors").code == 3


def test_the_papers_preset_searches_a_store_of_its_own_network(run, city, tmp_path):
    vectors = tmp_path / "printed.vectors"
    assert run("city", "embed", city, "-o", vectors, "--weights", "printed").code == 0
    locate = ("city", "locate", city, TEXT, "--json", "--preset", "paper")
    direct, named, stored = (
        run(*locate, *options) for options in ((), ("--weights", "printed"), ("--store", vectors))
    )
    assert direct.code == named.code == stored.code == 0
    cells = [mode["cell"] for mode in direct.json["modes"]]
    assert cells == [mode["cell"] for mode in named.json["modes"]]
    assert cells == [mode["cell"] for mode in stored.json["modes"]]
    assert run("city", "locate", city, TEXT, "--store", vectors).code == 10  # of another network


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
    one, two = (run(*evaluate, "--matcher", matcher) for matcher in ("relational", "embedding"))
    assert one.code == two.code == 0
    assert one.json != two.json
    assert run(*evaluate, "--matcher", "luck").code == 7
