import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from placegraph.core.options import check_options, in_radians, option, options_of, write_table
from placegraph.errors import OptionError


@dataclass(frozen=True)
class Noise:
    floor: float = option(0.1, "Least deviation.", unit="m")

    def __post_init__(self):
        check_options(self)


@dataclass(frozen=True)
class Base:
    share: float = option(0.25, "Share of all.", above=0, below=1)
    count: int | None = option(None, "Number.", minimum=1, maximum=9)
    kind: bool | Literal["auto"] = option("auto", "Kind.")
    free: object = None

    def __post_init__(self):
        check_options(self)


@dataclass(frozen=True)
class More(Base):
    pair: tuple[float, float] = option((0.5, 1.0), "Pair.", minimum=-1)
    names: tuple[str, ...] = option((), "Names.")
    noise: Noise = option(Noise(0.2), "Noise.")
    file: Path | None = option(None, "File.")


@pytest.mark.parametrize(
    "wrong",
    [
        {"share": 0}, {"share": 1.0}, {"share": math.nan}, {"share": True}, {"share": "0.5"},
        {"share": None}, {"count": 0}, {"count": 10}, {"count": 1.5}, {"kind": 1}, {"kind": "none"},
        {"pair": (1.0,)}, {"pair": (0.0, -2.0)}, {"pair": 1.0}, {"names": "ab"}, {"names": (1,)},
        {"noise": 0.1}, {"file": 3},
    ],
)  # fmt: skip
def test_values_out_of_range(wrong):
    (name,) = wrong
    with pytest.raises(OptionError, match=rf"^{name} is .*; it must be .*\.$"):
        More(**wrong)


def test_messages_name_the_range_and_good_values_are_taken():
    with pytest.raises(
        OptionError, match=r"^share is 2; it must be a number above 0 and below 1\.$"
    ):
        Base(share=2)
    with pytest.raises(OptionError, match=r"it must be a number at least 0 \[m\]\.$"):
        Noise(-1.0)
    with pytest.raises(OptionError, match="it must be True or False or 'auto'"):
        Base(kind="no")
    More(share=0.5, count=3, kind=False, pair=(0, 1), names=("a",), file="a.txt", free=[])


def test_tables_bounds_and_units():
    assert write_table(More).splitlines() == [
        "| `More` | default | values | meaning |",
        "|---|---|---|---|",
        "| `pair` | `(0.5, 1)` | a tuple of 2, each a number at least -1 | Pair. |",
        "| `names` | `()` | a tuple of any number, each a str | Names. |",
        "| `noise` | `Noise(floor=0.2)` | a Noise | Noise. |",
        "| `file` | `None` | a Path or None | File. |",
    ]
    infos = {entry.name: entry.info for owner in (Base, Noise) for entry in options_of(owner)}
    assert infos["share"].bounds == {"gt": 0, "lt": 1}
    assert infos["floor"].text == "Least deviation. [m]"
    assert in_radians({"yaw_deg": 180, "x": 1, "z": None}) == {"yaw": math.pi, "x": 1}
