"""Matchers: which points of a photograph and of a rendering of the map show the same spot.

    matches = matcher("sift").match(photograph, [rendering])

Choosing another is one word. Points have pixel centres at +0.5 everywhere.
"""

from __future__ import annotations

import inspect
from importlib import import_module
from pathlib import Path
from typing import Any

from placegraph.core import plugins
from placegraph.errors import OptionError
from placegraph.indoor.refine.matching.matches import Matcher, Matches

__all__ = ["MATCHERS", "Matcher", "Matches", "matcher"]

BUILT_IN = {
    "guided": "placegraph.indoor.refine.matching.guided.GuidedMatcher",
    "sift": "placegraph.indoor.refine.matching.sift.SiftMatcher",
}
EXTRA = {"xfeat": "learn", "roma": "learn", "romav2": "learn"}
"""Extras of matchers that other distributions of placegraph bring."""
MATCHERS = (*BUILT_IN, *EXTRA)
"""Names that `matcher` knows, beside those of other plugins (entry points `placegraph.matchers`)."""


def matcher(
    name: str,
    *,
    weights: Path | None = None,
    device: str = "cpu",
    **options: Any,  # noqa: ANN401  # the matcher's own
) -> Matcher:
    """Make a matcher.

    Parameters
    ----------
    name
        One of `MATCHERS`.
    weights
        File with its weights, where it has any; else they come from its own hub.
    device
        `cpu`, `cuda` or `auto`, where it runs a network; others run on the processor.
    options
        Its own: see its class.

    Raises
    ------
    OptionError
        There is no such matcher, or it has no such option, or it has no weights.
    MissingExtraError
        What it needs is not installed.
    InputError
        The weights are missing, no weights, or another network's.
    ServiceError
        The weights' hub cannot be reached.

    """
    if name in BUILT_IN:
        module, _, kind = BUILT_IN[name].rpartition(".")
        make = getattr(import_module(module), kind)
    elif name in EXTRA or name in plugins.plugins(plugins.MATCHERS):
        make = plugins.load_plugin(plugins.MATCHERS, name, EXTRA.get(name, ""))
    else:
        raise OptionError(f"matcher is {name!r}; choose one of {', '.join(map(repr, MATCHERS))}.")
    known = inspect.signature(make).parameters
    if weights is not None:
        options["weights"] = weights
    for option in options:
        if option not in known:
            own = ", ".join(n for n in known if n != "device")
            raise OptionError(f"The matcher {name!r} has no option {option!r}; it has {own}.")
    if "device" in known:
        options["device"] = device
    found: Matcher = make(**options)
    return found
