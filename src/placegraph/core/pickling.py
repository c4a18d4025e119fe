"""Pickling and HTML display of dataclasses.

Pickles only travel between processes: placegraph writes none to a file, and opens none.
"""

from __future__ import annotations

from dataclasses import fields
from importlib import import_module
from typing import Any

import numpy as np


class PickleFields:
    """Pickle support for dataclasses: stores the fields, drops cached values.

    Read-only arrays stay read-only, which plain pickling forgets: compiled code tells the two apart,
    and would be compiled twice.
    """

    __slots__ = ()

    def __reduce__(self) -> tuple[Any, ...]:
        values = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        return rebuild, (type(self), values, readonly_names(values))


def readonly_names(values: dict[str, Any]) -> tuple[str, ...]:
    """Return the names of the arrays that are read-only."""
    arrays = {name: array for name, array in values.items() if isinstance(array, np.ndarray)}
    return tuple(name for name, array in arrays.items() if not array.flags.writeable)


def rebuild(cls: type[Any], values: dict[str, Any], readonly: tuple[str, ...]) -> Any:  # noqa: ANN401
    """Undo `PickleFields.__reduce__` without checking the fields again."""
    instance = object.__new__(cls)
    for name, value in values.items():
        if name in readonly:
            value.flags.writeable = False
        object.__setattr__(instance, name, value)
    return instance


class HtmlRepr:
    """HTML display in Jupyter, by `placegraph.view.html_repr`, which is imported when it is needed."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        html: str = import_module("placegraph.view.html_repr").html(self)
        return html
