"""What runs networks of PyTorch: the device, and weights from a file that may be anything."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import check_regular
from placegraph.errors import InputError, MissingExtraError, OptionError

if TYPE_CHECKING:
    from placegraph.core.mapfile import MapFile


def torch_for(name: str, extra: str) -> Any:  # noqa: ANN401  # the module
    """PyTorch, for the matcher `name`; `MissingExtraError` with the extra that brings it."""
    try:
        import torch
    except ImportError as error:
        raise MissingExtraError(
            f"The matcher {name!r} needs PyTorch: pip install 'placegraph[{extra}]'."
        ) from error
    return torch


def select_device(torch: Any, device: str) -> Any:  # noqa: ANN401  # torch and torch.device
    """Device of this name; `auto` is a GPU where there is one.

    Raises `OptionError` where there is no such device: none is taken instead.
    """
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        found = torch.device(device)
    except RuntimeError as error:
        raise OptionError(f"device is {device!r}; it is 'cpu', 'cuda' or 'auto'.") from error
    if found.type == "cuda" and not torch.cuda.is_available():
        raise OptionError(f"device is {device!r}, but PyTorch sees no GPU here; 'cpu' works.")
    return found


def load_torch_file(torch: Any, path: Path) -> Any:  # noqa: ANN401
    """What a file of PyTorch holds, tensors and plain values only; nothing in it is run.

    All of it is read, and nothing mapped: another process that cuts the file short would end this one.
    Raises whatever PyTorch's parsers do.
    """
    return torch.load(check_regular(path), map_location="cpu", weights_only=True)


def read_state(torch: Any, path: Path, name: str) -> dict[str, Any]:  # noqa: ANN401
    """Weights from a file: tensors by name. Nothing in the file is run.

    Raises `InputError` where the file is missing, no file of weights, or holds anything else.
    """
    try:
        state = load_torch_file(torch, path)
    except FileNotFoundError as error:
        raise InputError(
            f"{path} does not exist; weights= names the file with the weights of {name!r}."
        ) from error
    except Exception as error:  # torch.load raises whatever its parsers do
        why = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise InputError(
            f"{path} cannot be read as weights of {name!r} ({why[:120]}); download it again."
        ) from error
    if not isinstance(state, dict) or not all(torch.is_tensor(v) for v in state.values()):
        raise InputError(f"{path} holds no tensors by name; weights of {name!r} are a state dict.")
    return state


@contextmanager
def check_weights(path: Path | str | None, name: str) -> Iterator[None]:
    """Where weights are put into a network: `InputError` where they are another network's."""
    try:
        yield
    except RuntimeError as error:
        lines = str(error).splitlines()
        why = " ".join((lines[1] if len(lines) > 1 else lines[0]).split())
        raise InputError(
            f"{path or 'The file from the hub'} holds weights of another network than {name!r} "
            f"({why[:160]}); give its own."
        ) from error


def to_float16(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[np.float16]]:
    """Arrays as the file holds them."""
    return {name: np.ascontiguousarray(array, np.float16) for name, array in arrays.items()}


def round_to_float16(
    names: Iterable[str], state: Mapping[str, NDArray[Any]]
) -> dict[str, NDArray[np.float32]]:
    """Arrays of these names as they will be read again."""
    return {n: a.astype(np.float32) for n, a in to_float16({n: state[n] for n in names}).items()}


def read_arrays(
    file: MapFile, sizes: Mapping[str, tuple[int, ...]]
) -> dict[str, NDArray[np.float32]]:
    """Arrays of a file by name, with as many axes as their sizes, finite.

    Raises as `MapFile.array` does, and `ValueError`.
    """
    found = {
        name: file.array(name, "<f2", len(size)).astype(np.float32) for name, size in sizes.items()
    }
    for name, array in found.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{name} holds what is no finite number")
    return found


def hash_weights(shape: object, arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 of a network's shape, by what it prints as, and of its weights as the file has them."""
    told = hashlib.sha256(repr(shape).encode())
    for name, array in sorted(to_float16(arrays).items()):
        told.update(name.encode() + array.tobytes())
    return told.hexdigest()
