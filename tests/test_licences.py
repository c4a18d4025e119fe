"""Everybody may use what is installed with placegraph: no GPL, nothing non-commercial or unsaid."""

import re
from importlib.metadata import PackageNotFoundError, distribution

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

FREE = re.compile(
    r"apache|\bMIT|\bBSD|\bISC|\bMPL|\bPSF|python software foundation|\bBSL-1|\b0BSD|\bzlib"
    r"|\bCC0|\bCNRI|\bLGPL|lesser general public|\bany-OSI|redistribution and use in source and binary forms",
    re.IGNORECASE,
)
BARRED = re.compile(
    r"\bA?GPL|affero|(?<!lesser )general public licen|non-?commercial|\bNC\b|proprietary",
    re.IGNORECASE,
)


def needed(*roots):
    """Names of everything installed that these ask for, with every extra, and what that asks for."""
    found, left = {}, [(root, None) for root in roots]
    while left:
        name, extras = left.pop()
        name = canonicalize_name(name)
        try:
            asks = distribution(name).requires or []
        except PackageNotFoundError:
            continue  # of an extra that is not installed
        known = found.setdefault(name, set())
        new = {"", *(extras or ())} - known
        if not new and extras is not None:
            continue
        known |= new
        for line in asks:
            asked = Requirement(line)
            here = extras is None or any(
                asked.marker is None or asked.marker.evaluate({"extra": e}) for e in ("", *extras)
            )
            if here:
                left.append((asked.name, tuple(asked.extras)))
    return sorted(set(found) - {canonicalize_name(root) for root in roots})


def licence_of(name):
    """What the metadata of a package say of its licence; where they say nothing, its licence's text."""
    package = distribution(name)
    told = package.metadata
    classes = [c for c in told.get_all("Classifier", []) if c.startswith("License ::")]
    said = told.get("License-Expression") or " ".join(classes) or told.get("License") or ""
    if FREE.search(said) or BARRED.search(said):
        return said
    texts = [f for f in package.files or () if "licen" in f.name.lower()]
    return " ".join([said, *(f.locate().read_text("utf-8") for f in texts)])


@pytest.mark.parametrize("name", needed("placegraph", "placegraph-lab"))
def test_everybody_may_use_it(name):
    said = licence_of(name)
    assert FREE.search(said), f"{name}: {said[:200]!r}"
    assert not BARRED.search(said), f"{name}: {said[:200]!r}"


def test_what_the_core_asks_for_is_looked_at():
    core = {"click", "lark", "numba", "llvmlite", "numpy", "osmium", "pillow", "rapidfuzz", "rich"}
    assert core <= set(needed("placegraph"))


@pytest.mark.parametrize(
    "said",
    ["GPL-3.0-or-later", "AGPL-3.0", "License :: OSI Approved :: GNU General Public License v3 (GPLv3)",
     "GNU Affero General Public License", "CC-BY-NC-4.0", "free for non-commercial use",
     "License :: Other/Proprietary License"],
)  # fmt: skip
def test_what_not_everybody_may_use_is_barred(said):
    assert BARRED.search(said)


def test_the_lesser_one_is_not():
    assert not BARRED.search("GNU Lesser General Public License v3 (LGPLv3), LGPL-2.1")
