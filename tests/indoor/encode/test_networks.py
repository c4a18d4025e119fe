import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from placegraph.core.estimate import Status
from placegraph.core.geometry import Camera
from placegraph.errors import InputError, MissingExtraError, OptionError
from placegraph.indoor.encode.networks import (
    PASCAL,
    SLOPE,
    DepthEstimator,
    Segmenter,
    depth_network,
    estimate_depth,
    label_capture,
    segmenter,
)
from placegraph.indoor.options import Likelihood, PoseSearchOptions
from placegraph.indoor.refine import RefineOptions
from placegraph.io.capture.capture import Capture, open_capture
from placegraph.io.capture.frame import Frame

SHARED = Path(__file__).resolve().parents[4] / "shared"
WEIGHTS = SHARED / "weights/deeplabv3_mnv2_pascal_quant.tflite"


@pytest.fixture(scope="module")
def network():
    if not WEIGHTS.exists():
        pytest.skip(f"{WEIGHTS} is not there")
    pytest.importorskip("ai_edge_litert")
    return segmenter(WEIGHTS, threads=1)


class Halves:
    def __init__(self, shape=(12, 16)):
        self.names = {3: "chair"}
        self.asked = 0
        self.shape = shape

    def size(self, width, height):
        return width // 4, height // 4

    def labels(self, rgb):
        assert rgb.shape == (48, 64, 3)
        self.asked += 1
        out = np.full(self.shape, -1, np.int32)
        out[:, : self.shape[1] // 2] = 3
        return out


@pytest.fixture
def capture():
    camera = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)
    image = np.zeros((48, 64, 3), np.uint8)
    depth = np.full((48, 64), 2.0, np.float32)
    frames = [Frame.from_arrays(image, camera, depth=depth, stamp=float(i)) for i in range(3)]
    return Capture.from_frames(frames)


def test_office_has_a_plant_and_a_sofa(network):
    folder = SHARED / "data/office"
    if not folder.exists():
        pytest.skip(f"{folder} is not there")
    assert isinstance(network, Segmenter)
    assert network.names == {i: name for i, name in enumerate(PASCAL) if name}
    assert len(PASCAL) == len(network.names) + 1 == 21
    frames = label_capture(open_capture(folder), network)
    seen = {}
    for i in range(0, 370, 45):
        labels = frames[i].labels()
        assert labels.shape == (frames.label_camera.height, frames.label_camera.width)
        for value, count in zip(*np.unique(labels, return_counts=True), strict=True):
            seen[int(value)] = seen.get(int(value), 0) + count / labels.size / 9
    named = {network.names[v]: share for v, share in seen.items() if v >= 0}
    assert 0.2 < seen[-1] < 0.98
    assert {"potted plant", "table", "chair", "sofa"} & set(named)
    assert max(named, key=named.get) in {"potted plant", "table", "chair", "sofa", "tv"}


def test_size_keeps_the_shape_of_the_image(network):
    assert network.size(540, 360) == (513, 342)
    assert network.size(360, 540) == (342, 513)
    assert network.size(100, 100) == (513, 513)
    wide, high = network.size(5000, 3)
    assert (wide, high) == (513, 1)
    grey = np.full((3, 500, 3), 128, np.uint8)
    assert network.labels(grey).shape == network.size(500, 3)[::-1]


@pytest.mark.usefixtures("network")
def test_names_file(tmp_path, rng):
    path = tmp_path / "names.json"
    path.write_text(json.dumps({"0": None, "9": "seat"}))
    other = segmenter(WEIGHTS, path, threads=1)
    assert other.names == {9: "seat"}
    labels = other.labels(rng.integers(0, 256, (48, 64, 3), np.uint8))
    assert set(np.unique(labels).tolist()) <= {-1, 9}


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"a": "b"}', '{"1": 2}', '{"-1": "x"}'])
def test_bad_names_files(content, tmp_path):
    path = tmp_path / "names.json"
    path.write_text(content)
    with pytest.raises(InputError, match=r"names\.json"):
        segmenter(tmp_path / "none.tflite", path)


@pytest.mark.parametrize("content", [b"", b"TFL3", b"\0" * 400, b"\x1c\0\0\0TFL3" + b"\xff" * 64])
def test_bad_weights(content, tmp_path, monkeypatch):
    pytest.importorskip("ai_edge_litert")
    path = tmp_path / "net.tflite"
    with pytest.raises(InputError, match="does not exist"):
        segmenter(path)
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"net\.tflite"):
        segmenter(path)
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    path.write_bytes(b"\x1c\0\0\0TFL3" + bytes(64))
    with pytest.raises(MissingExtraError, match="segment"):
        segmenter(path)


def test_labelled_is_lazy_and_remembers(capture):
    halves = Halves()
    seen = label_capture(capture, halves)
    assert halves.asked == 0
    assert seen.label_kind == "labels"
    assert seen.label_names == seen[0].label_names == {3: "chair"}
    assert (seen.label_camera.width, seen.label_camera.height) == (16, 12)
    for _ in range(2):
        assert (seen[1].labels()[:, :8] == 3).all()
    assert halves.asked == 1
    seen[1:][1].labels()
    assert halves.asked == 2
    np.testing.assert_array_equal(seen[0].depth(), capture[0].depth())
    assert capture[0].labels() is None


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    s = pytest.importorskip("ai_edge_litert.schema_py_generated")
    flatbuffers = pytest.importorskip("flatbuffers")

    def tensor(shape, kind, buffer=0):
        made = s.TensorT()
        made.shape, made.type, made.buffer = np.int32(shape), kind, buffer
        return made

    real = s.TensorType.FLOAT32
    model, code, graph, op = s.ModelT(), s.OperatorCodeT(), s.SubGraphT(), s.OperatorT()
    code.builtinCode = code.deprecatedBuiltinCode = s.BuiltinOperator.MEAN
    code.version, model.version = 1, 3
    axis = s.BufferT()
    axis.data = np.frombuffer(np.int32([3]).tobytes(), np.uint8)
    op.inputs, op.outputs = np.int32([0, 1]), np.int32([2])
    op.builtinOptionsType, op.builtinOptions = s.BuiltinOptions.ReducerOptions, s.ReducerOptionsT()
    op.builtinOptions.keepDims = True
    graph.tensors = [
        tensor([1, 8, 12, 3], real),
        tensor([1], s.TensorType.INT32, 1),
        tensor([1, 8, 12, 1], real),
    ]
    graph.inputs, graph.outputs, graph.operators = np.int32([0]), np.int32([2]), [op]
    model.operatorCodes, model.buffers, model.subgraphs = [code], [s.BufferT(), axis], [graph]
    builder = flatbuffers.Builder(512)
    builder.Finish(model.Pack(builder), b"TFL3")
    path = tmp_path_factory.mktemp("network") / "mean.tflite"
    path.write_bytes(bytes(builder.Output()))
    return path


def form(tmp_path, **content):
    path = tmp_path / "form.json"
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(("gives", "depth"), [("metres", 2.0), ("log metres", np.exp(2.0))])
def test_a_model_tells_metres(gives, depth, weights, tmp_path):
    told = form(tmp_path, gives=gives, mean=[0.1, 0.2, 0.3], deviation=[0.2, 0.1, 0.05])
    network = depth_network(weights, told, threads=1)
    assert isinstance(network, DepthEstimator)
    assert network.metric
    assert network.size(24, 8) == (12, 4)
    image = np.zeros((8, 24, 3), np.uint8)
    image[:, 12:] = np.rint(255 * np.array([0.5, 0.4, 0.4]))  # 2 deviations of each
    found = network.depth(image)
    assert found.shape == (4, 12)
    np.testing.assert_allclose(found[:, 7:], depth, rtol=0.01)
    if gives == "metres":
        assert np.isnan(found[:, :5]).all()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"gives": "inverse"}, "no scale"), ({"gives": "relative"}, "no scale"),
        ({"gives": "feet"}, "metres"), ({}, "gives"),
        ({"gives": "metres", "std": 1}, "JSON object"), ({"gives": "metres", "mean": 0.5}, "mean"),
        ({"gives": "metres", "mean": [0.5, None, 0.5]}, "mean"),
        ({"gives": "metres", "deviation": [0, 1, 1]}, "deviation"),
    ],
)  # fmt: skip
def test_bad_forms(content, words, tmp_path):
    with pytest.raises(InputError, match=words):
        depth_network(tmp_path / "none.tflite", form(tmp_path, **content))


class Rule:
    metric = True

    def __init__(self, rule, size=(16, 12)):
        self.rule, self.asked, self.wide_high = rule, 0, size

    def size(self, *_):
        return self.wide_high

    def depth(self, rgb):
        self.asked += 1
        return self.rule(rgb)


@pytest.fixture
def colours():
    camera = Camera(16, 12, 20.0, 20.0, 8.0, 6.0)
    image = np.zeros((12, 16, 3), np.uint8)
    return Capture.from_frames(Frame.from_arrays(image, camera, stamp=float(i)) for i in range(70))


def test_measured_is_lazy_and_remembers(colours):
    rule = Rule(lambda _: np.where(np.arange(16) < 8, 0.0, 3.0) * np.ones((12, 1)))
    seen = estimate_depth(colours, rule)
    assert rule.asked == 0
    assert seen.depth_camera == seen[0].depth_camera == colours.camera
    for _ in range(2):
        depth = seen[1].depth()
        assert np.isnan(depth[:, :8]).all()
        assert (depth[:, 8:] == 3.0).all()
    assert (rule.asked, depth.dtype, colours[1].depth()) == (1, np.float32, None)
    for frame in seen:
        frame.depth()
    assert rule.asked == 70
    seen[69].depth()
    assert rule.asked == 70
    seen[0].depth()
    assert rule.asked == 71


def test_what_is_refused(colours, capture, weights):
    with pytest.raises(OptionError, match="segmenter"):
        label_capture(capture, Halves((5, 5)))[0].labels()
    with pytest.raises(InputError, match="create it to describe the output of the network"):
        depth_network(weights)
    rule = Rule(lambda _: np.ones((5, 5)))
    seen = estimate_depth(colours, rule)
    with pytest.raises(
        OptionError, match=r"depth is float64 \(5, 5\), expected floating-point numbers of"
    ):
        seen[0].depth()
    with pytest.raises(OptionError, match="measured depth; remove the depth"):
        estimate_depth(seen, rule)
    rule.metric = False
    with pytest.raises(OptionError, match="no scale"):
        estimate_depth(colours, rule)


def test_a_pose_by_a_network(room, walk, truth):
    walk = walk[:5]
    known = {frame.rgb().tobytes(): frame.depth() for frame in walk}
    rng = np.random.default_rng(4)

    def rule(rgb):
        depth = known[rgb.tobytes()]
        return 1.05 * depth * np.exp(0.03 * rng.normal() + 0.05 * rng.normal(size=depth.shape))

    options = PoseSearchOptions(semantic=False, likelihood=Likelihood(depth_slope=SLOPE))
    bare = Capture.from_frames([replace(f, depth_camera=None, label_camera=None) for f in walk])
    network = Rule(rule, (walk.depth_camera.width, walk.depth_camera.height))
    estimate = room.localize(
        estimate_depth(bare, network), options=options, refine=RefineOptions(depth=False), seed=0
    )
    off = np.linalg.inv(truth(walk)[-1]) @ estimate.best.map_from_camera
    assert np.linalg.norm(off[:3, 3]) < 0.25
    assert estimate.status in {Status.OK, Status.AMBIGUOUS}
