"""How a notebook shows a map or an estimate: as a picture, drawn when the cell is shown."""

from __future__ import annotations

from importlib import import_module


class Shown:
    """What Jupyter shows as a picture.

    The one place below the faces that names one. It does so by text, as `placegraph` itself names
    what it offers: nothing of `placegraph.view` is imported before a notebook asks, and nothing
    here depends on it.
    """

    __slots__ = ()

    def _repr_html_(self) -> str:
        drawn: str = import_module("placegraph.view.notebook").html(self)
        return drawn
