import pickle
import subprocess
import sys
from importlib import import_module

import pytest
import torch
from safetensors.torch import save_file

from placegraph.errors import InputError

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
    "backbone": ("placegraph_learn.features", "_state", "path, 'x'", "safetensors"),
    "scenegraphloc": (
        "placegraph_learn.scenegraphloc.weights",
        "read_state",
        "path",
        "safetensors",
    ),
    "snapshot": ("placegraph_learn.scenegraphloc.weights", "read_state", "path", "pt"),
}


class Evil:
    def __reduce__(self):
        return (pytest.fail, ("a pickle was run",))


def write(path, content):
    (torch.save if path.suffix == ".pt" else save_file)(content, path)


@pytest.mark.parametrize("name", READERS)
def test_files_that_hold_no_weights_are_named_and_nothing_in_them_is_run(name, tmp_path):
    module, reader, arguments, ending = READERS[name]
    path, read = tmp_path / f"odd.{ending}", getattr(import_module(module), reader)
    given = [{"torch": torch, "path": path, "'x'": "x"}[a] for a in arguments.split(", ")]
    with pytest.raises(InputError, match=r"odd\."):
        read(*given)
    write(path, {"a": torch.ones(1 << 16)})
    whole = path.read_bytes()
    parts = [whole[: int(share * len(whole))] for share in (0.0, 0.1, 0.5, 0.99)]
    for content in (
        *parts,
        b"no weights at all",
        pickle.dumps(Evil()),
        pickle.dumps({"a": Evil()}),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"odd\."):
            read(*given)
    for content in ({"model": Evil()}, [torch.ones(2)]) if ending == "pt" else ():
        torch.save(content, path)
        with pytest.raises(InputError, match=r"odd\.pt"):
            read(*given)


@pytest.mark.parametrize(
    "name", ["networks", *(pytest.param(name, marks=pytest.mark.all) for name in list(READERS)[1:])]
)
def test_a_file_that_is_cut_short_while_its_weights_are_used_ends_no_process(name, tmp_path):

    module, reader, arguments, ending = READERS[name]
    path = tmp_path / f"a.{ending}"
    write(path, {"a": torch.ones(1 << 16)})
    program = CUT.format(module=module, reader=reader, arguments=arguments)
    command = [sys.executable, "-c", program, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    assert (done.returncode, done.stdout) == (0, "65536.0\n"), done.stderr
