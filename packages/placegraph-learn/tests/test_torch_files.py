import subprocess
import sys

import pytest

CUT = """
import os, sys
from pathlib import Path
import torch
from {module} import {reader} as read
path = Path(sys.argv[1])
weights = read({arguments})
weights = weights[0] if isinstance(weights, tuple) else weights
os.truncate(path, 10)
print(float(weights["a"].sum()))
"""
READERS = {
    "networks": ("placegraph_learn.torch_files", "read_state", "torch, path, 'x'", "pt"),
    "backbone": ("placegraph_learn.features", "_state", "torch, path, 'x'", "safetensors"),
    "scenegraphloc": (
        "placegraph_learn.scenegraphloc.weights", "read_state", "path", "safetensors",
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    "name", ["networks", *(pytest.param(name, marks=pytest.mark.all) for name in list(READERS)[1:])]
)
def test_a_file_that_is_cut_short_while_its_weights_are_used_ends_no_process(name, tmp_path):
    torch = pytest.importorskip("torch", reason="needs PyTorch (extra learn)")
    tensors = pytest.importorskip("safetensors.torch", reason="needs safetensors (extra learn)")
    module, reader, arguments, ending = READERS[name]
    path = tmp_path / f"a.{ending}"
    (torch.save if ending == "pt" else tensors.save_file)({"a": torch.ones(1 << 16)}, path)
    program = CUT.format(module=module, reader=reader, arguments=arguments)
    command = [sys.executable, "-c", program, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    assert (done.returncode, done.stdout) == (0, "65536.0\n"), done.stderr
