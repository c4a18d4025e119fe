"""Matchers: which points of a photograph and of a rendering of the map show the same spot.

    matches = matcher("sift").match(photograph, [rendering])

Choosing another is one word. Points have pixel centres at +0.5 everywhere.
"""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

from placegraph.core.plugins import load_module
from placegraph.errors import OptionError
from placegraph.indoor.refine.matching.matches import Matcher, Matches

__all__ = ["MATCHERS", "Matcher", "Matches", "matcher"]

MATCHERS = {
    "guided": "placegraph.indoor.refine.matching.guided.GuidedMatcher",
    "sift": "placegraph.indoor.refine.matching.sift.SiftMatcher",
    "xfeat": "placegraph_learn.xfeat.XFeatMatcher",
    "roma": "placegraph_learn.roma.RomaMatcher",
    "romav2": "placegraph_learn.roma.RomaV2Matcher",
}
"""Module and class of each matcher, imported when it is asked for. Options are keywords of the class;
it has `weights` and `device` where it runs a network."""


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
    if name not in MATCHERS:
        raise OptionError(f"matcher is {name!r}; there are {', '.join(map(repr, MATCHERS))}.")
    module, _, made = MATCHERS[name].rpartition(".")
    make = getattr(load_module(module, "learn"), made)
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
