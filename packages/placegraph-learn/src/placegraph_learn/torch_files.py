"""PyTorch: devices, and weights from untrusted files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from placegraph.core.files import check_regular
from placegraph.errors import InputError, OptionError


def select_device(torch: Any, device: str) -> Any:  # noqa: ANN401  # torch and torch.device
    """Return the device of this name; `auto` is a GPU where there is one.

    Raises `OptionError` where there is no such device; no other one replaces it.
    """
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        selected = torch.device(device)
    except RuntimeError as error:
        raise OptionError(f"device is {device!r}; choose 'cpu', 'cuda' or 'auto'.") from error
    if selected.type == "cuda" and not torch.cuda.is_available():
        raise OptionError(f"device is {device!r}, but PyTorch finds no GPU; use 'cpu'.")
    return selected


def load_torch_file(torch: Any, path: Path) -> Any:  # noqa: ANN401
    """Load tensors and plain values from a file of PyTorch without running any code in it.

    The file is read, not memory-mapped: a process that cuts it short would end this one. Raises
    the errors of PyTorch's parsers.
    """
    return torch.load(check_regular(path), map_location="cpu", weights_only=True)


def read_state(torch: Any, path: Path, name: str) -> dict[str, Any]:  # noqa: ANN401
    """Read weights from a file, tensors by name, without running any code in it.

    Raises `InputError` where the file is missing, or holds no state dict.
    """
    try:
        state = load_torch_file(torch, path)
    except FileNotFoundError as error:
        raise InputError(
            f"{path} does not exist; give weights= the file with the weights of {name!r}."
        ) from error
    except Exception as error:  # torch.load raises whatever its parsers do
        why = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise InputError(
            f"{path} cannot be read as weights of {name!r} ({why[:120]}); download it again."
        ) from error
    if not isinstance(state, dict) or not all(torch.is_tensor(v) for v in state.values()):
        raise InputError(
            f"{path} contains no named tensors; give the weights of {name!r} as a state dict."
        )
    return state


@contextmanager
def check_weights(path: Path | str | None, name: str) -> Iterator[None]:
    """Raise `InputError` where weights that the body puts into a network belong to another one."""
    try:
        yield
    except RuntimeError as error:
        lines = str(error).splitlines()
        why = " ".join((lines[1] if len(lines) > 1 else lines[0]).split())
        raise InputError(
            f"{path or 'The file from the hub'} contains weights of another network than {name!r} "
            f"({why[:160]}); give the weights of this one."
        ) from error
