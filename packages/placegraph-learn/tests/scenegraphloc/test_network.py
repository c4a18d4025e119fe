import numpy as np
import pytest
import torch

from placegraph.errors import OptionError
from placegraph_learn.scenegraphloc.network import (
    GraphAttention,
    Objects,
    SceneGraphLoc,
    Widths,
    unit,
)
from placegraph_learn.scenegraphloc.train import Truth, losses
from placegraph_learn.scenegraphloc.weights import read_weights

NEAR, SUMMED = 2e-5, 1e-4
"""Tolerances that the description of the conformance data suggests."""
HOOKS = {
    "reduce_layers": "patch_reduced", "patch_encoder": "patch_encoded", "patch_gcn": "patch_emb",
    "sg_encoder.object_encoder": "point_feat", "sg_encoder.object_embedding": "point_emb",
    "sg_encoder.structure_encoder.layer_stack.0": "gat_layer0_preact",
    "sg_encoder.structure_encoder": "gat_feat", "sg_encoder.structure_embedding": "gat_emb",
    "sg_encoder.meta_embedding_rel": "rel_emb", "sg_encoder.meta_embedding_attr": "attr_emb",
    "sg_encoder.img_patch_encoder": "img_view_mlp", "sg_encoder.pose_encoder": "img_view_pose",
    "sg_encoder.multiview_encoder": "img_view_attn",
    "sg_encoder.multiview_norm": "img_view_attn_ln", "sg_encoder.img_patch_embedding": "img_emb",
    "sg_encoder.fusion": "fused", "obj_embedding_encoder": "obj_emb",
}  # fmt: skip


@pytest.fixture(scope="module")
def given(shared):
    folder = shared / "conformance/scenegraphloc"
    if not folder.is_dir():
        pytest.skip(f"needs the conformance data: {folder} is not there")
    with np.load(folder / "inputs.npz") as inputs, np.load(folder / "outputs.npz") as outputs:
        return folder, dict(inputs), dict(outputs)


@pytest.fixture(scope="module")
def network(given):
    return read_weights(given[0] / "state_dict.safetensors").network


def _objects(inputs, edges):
    counts = torch.from_numpy(inputs["view_counts"])
    floats = {
        name: torch.from_numpy(inputs[key]).float()
        for name, key in (
            ("points", "obj_points"), ("offsets", "rel_pose"), ("relations", "rel_bow"),
            ("attributes", "attr_bow"), ("views", "view_feats"), ("poses", "view_poses"),
        )
    }  # fmt: skip
    owner = torch.repeat_interleave(torch.arange(len(counts)), counts)
    return Objects(
        edges=(torch.from_numpy(inputs[edges]),), sizes=(len(counts),), owner=owner, **floats
    )


@pytest.fixture(scope="module")
def found(given, network):
    _, inputs, _ = given
    out = {}
    modules = dict(network.named_modules())
    hooks = [
        modules[name].register_forward_hook(
            lambda _module, _inputs, output, key=key: out.__setitem__(key, output)
        )
        for name, key in HOOKS.items()
    ]
    pooled = modules["sg_encoder.img_patch_embedding"].register_forward_pre_hook(
        lambda _module, inputs: out.__setitem__("img_pooled", inputs[0])
    )
    with torch.no_grad():
        network.patches(torch.from_numpy(inputs["patch_features"]))
        network.objects(_objects(inputs, "edges"))
        for hook in (*hooks, pooled):
            hook.remove()
        rotated = network.patches(torch.from_numpy(inputs["patch_features_rot"]))
        complete = network.objects(_objects(inputs, "edges_complete"))
    out["patch_emb"] = out["patch_emb"].flatten(1, 2)
    out["patch_emb_rot"], out["obj_emb_complete"] = rotated.flatten(1, 2), complete
    out["patch_emb_norm"], out["obj_emb_norm"] = unit(out["patch_emb"]), unit(out["obj_emb"])
    out["sim"] = out["patch_emb_norm"] @ out["obj_emb_norm"].T
    out["obj_obj_sim"] = out["obj_emb_norm"] @ out["obj_emb_norm"].T
    out["sim_rot_complete"] = unit(out["patch_emb_rot"]) @ unit(complete).T
    for end in ("", "_rot_complete"):
        out[f"room_score{end}"] = out[f"sim{end}"].amax(dim=2).sum(dim=1)
    return out


@pytest.mark.parametrize(
    "key",
    [
        *HOOKS.values(), "img_pooled", "patch_emb_norm", "obj_emb_norm", "sim", "obj_obj_sim",
        "patch_emb_rot", "obj_emb_complete", "sim_rot_complete", "room_score", "room_score_rot_complete",
    ],
)  # fmt: skip
def test_every_intermediate_is_that_of_the_reference(given, found, key):
    expected = given[2][key]
    assert found[key].shape == expected.shape
    assert np.abs(found[key].numpy() - expected).max() < (SUMMED if "score" in key else NEAR)


@pytest.fixture(scope="module")
def truths(given):
    _, inputs, _ = given
    ids, categories = inputs["obj_ids"], torch.from_numpy(inputs["obj_nyu40"])
    for_image = []
    for marks in inputs["patch_anno_rot"]:
        same = marks[:, None] == ids
        target = np.where(same.any(axis=1), same.argmax(axis=1), -1)
        for_image.append(Truth(torch.from_numpy(marks), torch.from_numpy(target), categories))
    return for_image


def right(patches, objects, truth):
    shown = truth.target >= 0
    return (patches[shown] @ objects.T).argmax(dim=1) == truth.target[shown]


def test_the_loss_is_that_of_the_reference(given, found, truths):
    patches, objects = unit(found["patch_emb_rot"]), unit(found["obj_emb_complete"])
    pairs = list(zip(patches, truths, strict=True))
    each = torch.cat([losses(p, objects, t) for p, t in pairs])
    best = torch.cat([right(p, objects, t) for p, t in pairs])
    assert len(each) == 206
    assert np.abs(each.numpy() - given[2]["loss_per_patch"]).max() < SUMMED
    assert abs(float(each.mean()) - float(given[2]["loss"])) < SUMMED
    assert np.array_equal(best.numpy(), given[2]["loss_argmax_correct"] > 0)


TINY = Widths(
    feature=6, embedding=8, hidden=10, gate=3, modality=4, points=(3, 4, 5), graph=6, view=8,
    pose_hidden=4, relations=3, attributes=2,
)  # fmt: skip


@pytest.fixture(scope="module")
def tiny():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        return SceneGraphLoc(TINY).eval()


def _random(rng, sizes, views):
    def normal(*shape):
        return torch.from_numpy(rng.normal(size=shape)).float()

    n = sum(sizes)
    edges = tuple(
        torch.tensor([(a, b) for a in range(k) for b in range(k) if a != b and rng.random() < 0.6],
                     dtype=torch.int64).reshape(-1, 2)
        for k in sizes
    )  # fmt: skip
    owner = torch.repeat_interleave(torch.arange(n), torch.tensor(views))
    return Objects(
        normal(n, 9, 3), normal(n, 3), edges, sizes, normal(n, 3), normal(n, 2), owner,
        normal(len(owner), 6), normal(len(owner), 7),
    )  # fmt: skip


def test_rooms_encoded_together_are_as_encoded_alone(tiny, rng):
    both = _random(rng, (3, 2), [1, 3, 2, 2, 1])
    alone = [
        Objects(both.points[a:b], both.offsets[a:b], (edges,), (b - a,), both.relations[a:b],
                both.attributes[a:b], both.owner[v:w] - a, both.views[v:w], both.poses[v:w])
        for (a, b), (v, w), edges in zip(((0, 3), (3, 5)), ((0, 6), (6, 9)), both.edges, strict=True)
    ]  # fmt: skip
    with torch.no_grad():
        together = tiny.objects(both)
        apart = torch.cat([tiny.objects(one) for one in alone])
    assert torch.allclose(together, apart, atol=1e-6)


def test_the_order_of_points_and_views_does_not_matter(tiny, rng):
    objects = _random(rng, (2,), [4, 3])
    points, order = rng.permutation(9), [2, 0, 3, 1, 6, 5, 4]
    turned = Objects(
        objects.points[:, points], objects.offsets, objects.edges, (2,), objects.relations,
        objects.attributes, objects.owner, objects.views[order], objects.poses[order],
    )  # fmt: skip
    with torch.no_grad():
        assert torch.allclose(tiny.objects(objects), tiny.objects(turned), atol=1e-6)


def test_messages_go_from_source_to_target_and_self_loops_count_once(rng):
    layer = GraphAttention(3, 4, 2)
    x = torch.from_numpy(rng.normal(size=(3, 3))).float()
    edges = torch.tensor([[0, 1], [0, 1], [2, 2]])
    with torch.no_grad():
        h = layer.lin(x).reshape(3, 2, 2)
        out = layer(x, edges).reshape(3, 2, 2)
        # nothing but itself reaches 0 and 2; the edge to 1, drawn twice, counts twice
        assert torch.allclose(out[0], h[0], atol=1e-6)
        assert torch.allclose(out[2], h[2], atol=1e-6)
        scores = torch.nn.functional.leaky_relu(
            torch.stack([(h[s] * layer.att_src[0] + h[1] * layer.att_dst[0]).sum(-1)
                         for s in (0, 0, 1)]), 0.2,
        )  # fmt: skip
        share = scores.softmax(dim=0)[:, :, None]
        assert torch.allclose(out[1], (share * h[[0, 0, 1]]).sum(0), atol=1e-6)


def test_normalisation_of_points_has_no_say(tiny, rng):
    objects = _random(rng, (2,), [1, 1])
    with torch.no_grad():
        before = tiny.objects(objects)
        tiny.sg_encoder.object_encoder.bn2.running_mean += 5.0
        assert torch.equal(tiny.objects(objects), before)


@pytest.mark.parametrize("wrong", [{"embedding": 0}, {"graph": 7}, {"points": (3, 0, 2)}])
def test_impossible_widths_are_refused(wrong):
    with pytest.raises(OptionError, match=next(iter(wrong))):
        Widths(**wrong)
