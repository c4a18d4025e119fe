import pytest
import torch

from placegraph.errors import InputError, MapError, OptionError
from placegraph_learn.scenegraphloc.network import SceneGraphLoc, Widths
from placegraph_learn.scenegraphloc.weights import digest_of, read_weights, write_weights

TINY = Widths(
    feature=6, embedding=8, hidden=10, gate=3, modality=4, points=(3, 4, 5), graph=6, view=8,
    pose_hidden=4, relations=3, attributes=2,
)  # fmt: skip
LIN = "sg_encoder.structure_encoder.layer_stack.{}.lin{}.weight"


@pytest.fixture
def network():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        return SceneGraphLoc(TINY).eval()


@pytest.fixture
def state(network):
    return {k: v.clone() for k, v in network.state_dict().items()}


@pytest.fixture
def snapshot(tmp_path):
    def write(state, **more):
        path = tmp_path / "epoch-3.pth.tar"
        torch.save({"epoch": 3, "iteration": 90, "model": state} | more, path)
        return path

    return write


def _old_spelling(state):
    out = dict(state)
    for layer in (0, 1):
        weight = out.pop(LIN.format(layer, ""))
        out[LIN.format(layer, "_src")], out[LIN.format(layer, "_dst")] = weight, weight.clone()
    return out


def test_written_weights_are_read_again(network, tmp_path):
    write_weights(tmp_path / "a.safetensors", network, {"features": "colour"})
    weights = read_weights(tmp_path / "a.safetensors")
    assert weights.notes == {"features": "colour"}
    assert weights.network.widths == TINY
    assert weights.digest == digest_of(network)
    assert not weights.network.training
    for missing in ("none.pth", "."):
        with pytest.raises(InputError):
            read_weights(tmp_path / missing)
    with pytest.raises(OptionError, match="safetensors"):
        write_weights(tmp_path / "a.pth", network, {})
    with pytest.raises(MapError):
        write_weights(tmp_path / "nowhere" / "a.safetensors", network, {})
    for key, value in network.state_dict().items():
        assert torch.equal(weights.network.state_dict()[key], value), key


def test_both_spellings_of_the_graph_attention_are_read(network, state, snapshot):
    assert LIN.format(0, "") in state  # our own
    new = read_weights(snapshot(state))
    old = read_weights(snapshot(_old_spelling(state)))
    assert new.digest == old.digest == digest_of(network)


def test_what_nobody_needs_is_ignored_and_may_be_absent(network, state, snapshot, tmp_path):
    more = {f"{p}.weight": torch.ones(2) for p in
            ("backbone", "patch_global_encoder.a", "obj_global_encoder")}  # fmt: skip
    optimizer = {"state": {}, "param_groups": [{"lr": 1.1e-3}]}
    path = snapshot(state | more, optimizer=optimizer, scheduler={"last_epoch": 3})
    assert read_weights(path).digest == digest_of(network)
    torch.save(state, tmp_path / "bare.pth")
    assert read_weights(tmp_path / "bare.pth").digest == digest_of(network)


def test_the_digest_tells_weights_apart_by_what_has_a_say(network):
    before = digest_of(network)
    network.sg_encoder.object_encoder.bn1.weight.data += 1.0
    assert digest_of(network) == before
    network.sg_encoder.fusion.weight.data[2] += 1e-3
    assert digest_of(network) != before


def _without(key):
    return lambda state: {k: v for k, v in state.items() if k != key}


def _with(key, value):
    return lambda state: state | {key: value}


WRONG = {
    "missing": (_without("obj_embedding_encoder.mlp_layers.6.bias"),
                "obj_embedding_encoder.mlp_layers.6.bias.*missing"),
    "missing attention": (_without(LIN.format(1, "")), "layer_stack.1.lin.weight.*missing"),
    "unexpected": (_with("sg_encoder.extra", torch.ones(1)), "sg_encoder.extra.*unexpected"),
    "misshapen": (_with("patch_gcn.blocks.0.conv1.weight", torch.ones(8, 8, 1, 1)),
                  r"patch_gcn.blocks.0.conv1.weight.*\(8, 8, 1, 1\), not \(8, 8, 3, 3\)"),
    "misshapen throughout": (_with("patch_encoder.mlp_layers.3.weight", torch.ones(9, 10)),
                             "shape"),
    "no dimensions": (_with("reduce_layers.norm1.weight", torch.tensor(1.0)), "shape"),
    "no width": (_with("reduce_layers.norm1.weight", torch.ones(0)), "feature is 0"),
    "NaN": (_with("sg_encoder.fusion.weight", torch.full((5, 1), torch.nan)),
            "sg_encoder.fusion.weight.*not a number"),
    "half an old spelling": (
        lambda s: {k: v for k, v in _old_spelling(s).items() if k != LIN.format(0, "_dst")},
        "lin_src.weight', but not .*lin_dst.weight"),
    "two that differ": (lambda s: _old_spelling(s) | {LIN.format(0, "_dst"): torch.ones(6, 3)},
                        "differ"),
    "not a tensor": (_with("sg_encoder.fusion.weight", 3), "not a tensor"),
    "nothing": (lambda _: {}, "not a dict of named weights"),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_key_is_named_with_file_and_mend(state, snapshot, what):
    spoil, message = WRONG[what]
    path = snapshot(spoil(state))
    with pytest.raises(InputError, match=message) as error:
        read_weights(path)
    assert str(path) in str(error.value)
