import importlib

import pytest

OPERATORS = "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"


@pytest.fixture(scope="session")
def timm():
    torch = pytest.importorskip("torch", reason="needs PyTorch: pip install 'placegraph[learn]'")
    library = None
    try:
        importlib.import_module("torchvision")
    except ImportError:
        pytest.skip("needs torchvision, which timm does: pip install 'placegraph[learn]'")
    except RuntimeError:  # operator torchvision::nms does not exist
        library = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            library.define(name + OPERATORS)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # on busy cores, threads of small networks mostly wait for each other
    yield pytest.importorskip("timm", reason="needs timm: pip install 'placegraph[learn]'")
    torch.set_num_threads(threads)
    del library  # what it declared lives as long as it does
