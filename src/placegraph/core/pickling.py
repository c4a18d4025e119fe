"""Pickling and HTML display of dataclasses.

Pickles go to other processes only: none is written to a file, and none is opened.
"""

from __future__ import annotations

from dataclasses import fields
from importlib import import_module
from typing import Any

import numpy as np


class PickleFields:
    """A dataclass that `pickle` takes by its fields alone.

    Tables, compiled casters and locks stay behind and are made again where they are needed. Arrays
    that nobody may write stay so, which pickling forgets: compiled code tells the two apart, and
    would be compiled twice.
    """

    __slots__ = ()

    def __reduce__(self) -> tuple[Any, ...]:
        values = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        return rebuild, (type(self), values, readonly_names(values))


def readonly_names(values: dict[str, Any]) -> tuple[str, ...]:
    """Names of the arrays that nobody may write."""
    arrays = {name: array for name, array in values.items() if isinstance(array, np.ndarray)}
    return tuple(name for name, array in arrays.items() if not array.flags.writeable)


def rebuild(cls: type[Any], values: dict[str, Any], kept: tuple[str, ...]) -> Any:  # noqa: ANN401
    """What `PickleFields` took apart; nothing is checked twice."""
    made = object.__new__(cls)
    for name, value in values.items():
        if name in kept:
            value.flags.writeable = False
        object.__setattr__(made, name, value)
    return made


class HtmlRepr:
    """What Jupyter shows as a picture.

    The one place below the faces that names one. It does so by text, as `placegraph` itself names
    what it offers: nothing of `placegraph.view` is imported before a notebook asks, and nothing
    here depends on it.
    """

    __slots__ = ()

    def _repr_html_(self) -> str:
        drawn: str = import_module("placegraph.view.notebook").html(self)
        return drawn
