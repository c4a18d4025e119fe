"""Weights of the network: read from the authors' snapshots or .safetensors, and written.

Nothing in a file is run: snapshots are read as tensors and plain values only.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from placegraph.core.files import check_regular, write_file
from placegraph.errors import InputError, OptionError
from placegraph_learn.scenegraphloc.network import SceneGraphLoc, Widths
from placegraph_learn.torch_files import load_torch_file

IGNORED = ("backbone.", "patch_global_encoder.", "obj_global_encoder.")
"""Keys of what the published training can be told to bring along and nobody needs."""
_SOURCE = re.compile(r"(sg_encoder\.structure_encoder\.layer_stack\.\d+\.lin)_(src|dst)\.weight")
NOTES = "placegraph"
"""Name of the metadata of .safetensors files that we write."""
_MEND = "give the published snapshot, or output of `placegraph scene train`"


@dataclass(frozen=True, eq=False)
class Weights:
    """A network, and what its file says of how it was trained."""

    network: SceneGraphLoc
    """In the state for inference."""
    notes: dict[str, str]
    """Notes in .safetensors files: `features`, `temperature` and the like."""
    digest: str
    """Hash of all weights in use, 16 hexadecimal digits."""


def read_weights(path: str | PathLike[str]) -> Weights:
    """Return network from a snapshot (a dict with `model`) or a .safetensors file, by its key names.

    Both spellings of the graph attention are read: `lin.weight`, and `lin_src.weight` with an equal
    `lin_dst.weight`. Widths are those that the shapes tell.

    Raises `InputError`: the file is missing, cut short or no checkpoint; a key is missing,
    unexpected or of a wrong shape; a weight is not a number.
    """
    state, notes = read_state(Path(path))
    network = network_of(state, str(path))
    return Weights(network, notes, digest_of(network))


def read_state(path: Path, advice: str = _MEND) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return tensors by key and notes of a file; raises as `read_weights` does, with the mend given."""
    try:
        check_regular(path).open("rb").close()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}; {advice}.") from error
    if path.suffix == ".safetensors":
        return _safetensors(path, advice)
    found = read_snapshot(path, advice)
    state = found.get("model", found)
    if not isinstance(state, dict) or not state:
        raise InputError(f"{path}: `model` is not a dict of named weights; {advice}.")
    for key, value in state.items():
        if not isinstance(key, str) or not isinstance(value, Tensor):
            raise InputError(f"{path}: {str(key)[:60]!r} is not a tensor; {advice}.")
    return dict(state), {}


def read_snapshot(path: Path, advice: str = _MEND) -> dict[str, Any]:
    """Return the dict of a snapshot; `InputError` where the file is cut short or anything else."""
    try:
        found = load_torch_file(torch, path)
    except Exception as error:  # torch.load raises whatever its parsers do
        why = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise InputError(
            f"{path} is truncated, or not a checkpoint ({why[:100]}); copy it again, or {advice}."
        ) from error
    if not isinstance(found, dict):
        raise InputError(f"{path} contains a {type(found).__name__}, not a dict; {advice}.")
    return found


def network_of(state: Mapping[str, Tensor], source: str) -> SceneGraphLoc:
    """Return network with the weights of a state dict; `source` is named in errors (`read_weights`)."""
    own = {k: v for k, v in _one_spelling(state, source).items() if not k.startswith(IGNORED)}
    try:
        widths = Widths.of({key: tuple(value.shape) for key, value in own.items()})
        with torch.device("meta"):
            network = SceneGraphLoc(widths)
    except OptionError as error:
        raise InputError(f"{source}: {error} This network is unknown; {_MEND}.") from error
    expected = network.state_dict()
    missing = sorted(expected.keys() - own.keys())
    unexpected = sorted(own.keys() - expected.keys())
    for what, keys in (("is missing", missing), ("is unexpected", unexpected)):
        if keys:
            others = f", and {len(keys) - 1} more" if len(keys) > 1 else ""
            raise InputError(f"{source}: key {keys[0]!r} {what}{others}; {_MEND}.")
    for key, value in own.items():
        wanted = tuple(expected[key].shape)
        if tuple(value.shape) != wanted:
            raise InputError(
                f"{source}: key {key!r} has shape {tuple(value.shape)}, not {wanted}; {_MEND}."
            )
        if not bool(torch.isfinite(value).all()):
            raise InputError(
                f"{source}: key {key!r} contains a value that is not a number; {_MEND}."
            )
    ready = {k: v.detach().to(expected[k].dtype).clone() for k, v in own.items()}
    network.load_state_dict(ready, assign=True)
    for parameter in network.parameters():
        parameter.requires_grad_(True)
    return network.eval()


def digest_of(network: SceneGraphLoc) -> str:
    """Return 16 hexadecimal digits of all weights that have a say; two networks differ where these do."""
    digest = hashlib.sha256()
    for key, value in sorted(network.state_dict().items()):
        if _has_a_say(key):
            digest.update(f"{key} {tuple(value.shape)}".encode())
            digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def write_weights(
    path: str | PathLike[str], network: SceneGraphLoc, notes: Mapping[str, str]
) -> None:
    """Write a .safetensors file in one go, keys spelled as the network's.

    Raises `OptionError` where the path ends otherwise, `MapError` where it cannot be written.
    """
    if Path(path).suffix != ".safetensors":
        raise OptionError(
            f"{path}: weights are written as .safetensors; choose a file with this ending."
        )
    state = {k: v.detach().cpu().contiguous() for k, v in network.state_dict().items()}
    # one entry: the order of several is not always the same, and so the file's bytes
    write_file(path, [save(state, {NOTES: json.dumps(dict(notes), sort_keys=True)})])


def _safetensors(path: Path, advice: str) -> tuple[dict[str, Tensor], dict[str, str]]:
    try:
        with safe_open(path, "pt") as file:
            # copied: whoever cuts the file short later ends nobody
            state = {key: file.get_tensor(key).clone() for key in file.keys()}  # noqa: SIM118
            notes = json.loads((file.metadata() or {}).get(NOTES, "{}"))
    except (SafetensorError, ValueError) as error:
        raise InputError(
            f"{path} is truncated, or not a .safetensors file ({str(error)[:100]}); copy it again, "
            f"or {advice}."
        ) from error
    return state, {str(k): str(v) for k, v in dict(notes).items()}


def _one_spelling(state: Mapping[str, Tensor], source: str) -> dict[str, Tensor]:
    """Return weights with those of the graph attention spelled `lin.weight`."""
    out = {key: value for key, value in state.items() if not _SOURCE.fullmatch(key)}
    for key, value in state.items():
        found = _SOURCE.fullmatch(key)
        if not found:
            continue
        stem, end = found[1], found[2]
        twin = f"{stem}_{'dst' if end == 'src' else 'src'}.weight"
        if twin not in state:
            raise InputError(f"{source} has the key {key!r}, but not {twin!r}; {_MEND}.")
        if not torch.equal(value, state[twin]):
            raise InputError(f"{source}: the keys {key!r} and {twin!r} differ, but must be equal.")
        if not torch.equal(out.setdefault(f"{stem}.weight", value), value):
            raise InputError(
                f"{source}: the keys {key!r} and {stem + '.weight'!r} differ, but must be equal."
            )
    return out


def _has_a_say(key: str) -> bool:
    idle = key.startswith("sg_encoder.object_encoder.bn") or key.endswith("num_batches_tracked")
    return not idle
