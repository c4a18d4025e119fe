"""Depth by networks: real models of a few bytes, captures that they measure, a pose by them."""

import json

import numpy as np
import pytest

from placegraph.core.estimate import Status
from placegraph.core.geometry import Camera
from placegraph.errors import InputError, OptionError
from placegraph.indoor.encode.depth_network import SLOPE, DepthEstimator, depth_network, measured
from placegraph.indoor.options import FilterOptions, Likelihood
from placegraph.indoor.refine import RefineOptions
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A model (1, 8, 12, 3) to (1, 8, 12, 1): the mean of what it is given of a pixel."""
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
    """Colours come as they were trained with, and what is not above 0 m is not known."""
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
        ({"gives": "inverse"}, "no scale"),
        ({"gives": "relative"}, "no scale"),
        ({"gives": "feet"}, "metres"),
        ({}, "gives"),
        ({"gives": "metres", "std": 1}, "JSON object"),
        ({"gives": "metres", "mean": 0.5}, "mean"),
        ({"gives": "metres", "mean": [0.5, None, 0.5]}, "mean"),
        ({"gives": "metres", "deviation": [0, 1, 1]}, "deviation"),
    ],
)
def test_bad_forms(content, words, tmp_path):
    with pytest.raises(InputError, match=words):
        depth_network(tmp_path / "none.tflite", form(tmp_path, **content))


def test_a_model_without_its_form(weights):
    with pytest.raises(InputError, match=r"mean\.json does not exist; say"):
        depth_network(weights)


class Rule:
    """Depth by a rule of one's own; counts how often it is asked."""

    metric = True

    def __init__(self, rule, size=(16, 12)):
        self.rule, self.asked, self.wide_high = rule, 0, size

    def size(self, *_):
        return self.wide_high

    def depth(self, rgb):
        self.asked += 1
        return self.rule(rgb)


def bare(capture):
    """The capture without depth and labels."""
    return Capture.from_frames(
        Frame.from_arrays(
            f.rgb(), f.camera, odometry=f.odometry, gravity=f.gravity, stamp=f.stamp, index=f.index
        )
        for f in capture
    )


@pytest.fixture
def colours():
    camera = Camera(16, 12, 20.0, 20.0, 8.0, 6.0)
    image = np.zeros((12, 16, 3), np.uint8)
    return Capture.from_frames(Frame.from_arrays(image, camera, stamp=float(i)) for i in range(70))


def test_measured_is_lazy_and_remembers(colours):
    rule = Rule(lambda _: np.where(np.arange(16) < 8, 0.0, 3.0) * np.ones((12, 1)))
    seen = measured(colours, rule)
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


def test_what_is_refused(colours):
    rule = Rule(lambda _: np.ones((5, 5)))
    seen = measured(colours, rule)
    with pytest.raises(OptionError, match="promised"):
        seen[0].depth()
    with pytest.raises(OptionError, match="depth of their own"):
        measured(seen, rule)
    rule.metric = False
    with pytest.raises(OptionError, match="no scale"):
        measured(colours, rule)


def test_a_pose_by_a_network(room, walk, truth):
    """Depth that errs as networks do places images that alone are not believed."""
    walk = walk[:5]
    known = {frame.rgb().tobytes(): frame.depth() for frame in walk}
    rng = np.random.default_rng(4)

    def rule(rgb):
        depth = known[rgb.tobytes()]
        return 1.05 * depth * np.exp(0.03 * rng.normal() + 0.05 * rng.normal(size=depth.shape))

    options = FilterOptions(semantic=False, likelihood=Likelihood(depth_slope=SLOPE))
    network = Rule(rule, (walk.depth_camera.width, walk.depth_camera.height))
    estimate = room.localize(
        measured(bare(walk), network), options=options, refine=RefineOptions(depth=False), seed=0
    )
    off = np.linalg.inv(truth(walk)[-1]) @ estimate.best.map_from_camera
    assert np.linalg.norm(off[:3, 3]) < 0.25
    assert estimate.status in {Status.OK, Status.AMBIGUOUS}
