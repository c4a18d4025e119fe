"""JSON made wrong where it says something: values, keys, lists and depth."""

from __future__ import annotations

import copy
import json
from typing import Any

from numpy.random import Generator

from placegraph_lab.campaign.mutate_bytes import flipped

VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 0.5, -0.0, 2**31, 2**53 + 1, 2**63, 2**64, -(2**63) - 1, 1e300,
    -1e300, 1e-300, 10**400, float("nan"), float("inf"), "", "x", "0", "1e5", "\0", "\u202e\x1b[2J",
    "\ud800", "../..", "/dev/zero", "a" * 3000, [], {}, [[]], [None], {"": 0}, [0] * 3000, "true",
)  # fmt: skip
"""What may stand where another value stood."""


def changed(data: bytes, rng: Generator) -> bytes:
    """One to three changes; of what is no JSON the bytes."""
    try:
        root = {"": json.loads(data)}
    except (ValueError, RecursionError):
        return flipped(data, rng)
    if rng.random() < 0.03:
        deep = int(rng.choice([500, 20_000]))
        return b"[" * deep + data + b"]" * deep
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        holder, key = _site(root, rng)
        kind = int(rng.integers(10))
        value = holder[key]
        if kind < 4:
            holder[key] = VALUES[rng.integers(len(VALUES))]
        elif kind == 4 and isinstance(value, int | float):
            holder[key] = value * float(rng.choice([-1.0, 0.001, 1e3, 1e9])) + float(
                rng.integers(-2, 3)
            )
        elif kind == 5 and holder is not root:
            del holder[key]
        elif kind == 6 and isinstance(value, list):
            holder[key] = value * int(rng.choice([2, 50])) if len(value) < 1000 else value[:1]
        elif kind == 7 and isinstance(holder, dict):
            holder[str(rng.choice(["", "x", "\0", "__class__", "id"]))] = copy.deepcopy(value)
        elif kind == 8 and isinstance(value, str):
            holder[key] = flipped(value.encode(), rng).decode("utf-8", "replace")
        else:
            other, at = _site(root, rng)
            holder[key] = copy.deepcopy(other[at])
    text = json.dumps(root.get(""))
    return text.encode("utf-8", "surrogatepass")


def _site(root: dict[str, Any], rng: Generator) -> tuple[Any, Any]:
    """Where a value stands, by as many steps as chance has it: what lies high is found as often."""
    holder: Any = root
    key: Any = ""
    depth = 0
    while (
        isinstance(holder[key], dict | list)
        and holder[key]
        and rng.random() < (0.98, 0.9)[depth > 1]
    ):
        depth += 1
        holder = holder[key]
        key = rng.integers(len(holder)) if isinstance(holder, list) else None
        key = int(key) if key is not None else list(holder)[rng.integers(len(holder))]
    return holder, key
