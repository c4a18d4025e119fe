import pytest

pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")


def test_variants_differ_from_ours_and_two_of_them_are_as_printed():
    from placegraph_lab.tables.named.outdoor_ablation import OURS, variants
    from placegraph_learn.city.train import TrainOptions

    every = variants(TrainOptions(seed=3))
    ours = every.pop(OURS)
    assert all(options != ours and options.seed == 3 for options in every.values())
    printed = {name: o.losses for name, o in every.items() if o.shape.printed}
    assert sorted(printed.values()) == [("eq17", "eq18"), ("eq17", "eq18", "embedding")]
    assert not any("," in name for name in every)  # `--only` splits there
