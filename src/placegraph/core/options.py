"""Options defined once, as fields of dataclasses: default, unit, range, help and command-line flag."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import Field, dataclass, field, fields
from difflib import get_close_matches
from functools import cache
from math import isfinite, radians
from numbers import Real
from os import PathLike
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from placegraph.errors import OptionError

T = TypeVar("T")
_KEY = "placegraph.option"


@dataclass(frozen=True, slots=True, kw_only=True)
class OptionInfo:
    """Description of one option; bounds apply to a number and to each number of a tuple."""

    help: str
    unit: str = ""
    minimum: float = 0
    above: float | None = None
    maximum: float | None = None
    below: float | None = None
    flag: str = ""
    """Name on the command line, such as ``--depth/--no-depth``; empty: the option has none."""
    panel: str = "Options"
    """Heading in the help of the command."""
    commas: bool = False
    """Whether the values of a tuple are one word on the command line, separated by commas."""

    @property
    def bounds(self) -> dict[str, float]:
        """Bounds of a number, by their names in annotated-types and pydantic."""
        least = ("ge", self.minimum) if self.above is None else ("gt", self.above)
        bounds = dict([least, ("le", self.maximum), ("lt", self.below)])
        return {name: b for name, b in bounds.items() if b is not None and isfinite(b)}

    @property
    def text(self) -> str:
        """Help with the unit."""
        return f"{self.help} [{self.unit}]" if self.unit else self.help


def option(default: T, help: str, *, repr: bool = True, **info: Any) -> T:  # noqa: A002, ANN401
    """Return a dataclass field with its description; `info`: fields of `OptionInfo`."""
    metadata = {_KEY: OptionInfo(help=help, **info)}
    made: T = field(default=default, repr=repr, metadata=metadata)
    return made


class OptionField(NamedTuple):
    """One option of a dataclass."""

    name: str
    default: Any
    hint: Any
    """Type, with annotations resolved."""
    info: OptionInfo


@cache
def options_of(owner: type) -> tuple[OptionField, ...]:
    """Return the options of a dataclass, in the order of its fields."""
    hints = get_type_hints(owner)
    described: Iterator[Field[Any]] = (entry for entry in fields(owner) if _KEY in entry.metadata)
    return tuple(
        OptionField(entry.name, entry.default, hints[entry.name], entry.metadata[_KEY])
        for entry in described
    )


def check_options(owner: object) -> None:
    """Raise `OptionError` if an option of a dataclass instance has another type or is out of range."""
    cls: Any = type(owner)
    for name, _, hint, info in options_of(cls):
        value = getattr(owner, name)
        if not _accepts(value, hint, info):
            raise OptionError(f"{name} is {value!r}; it must be {_describe(hint, info)}.")


def _accepts(value: Any, hint: Any, info: OptionInfo) -> bool:  # noqa: ANN401
    origin, args = get_origin(hint), get_args(hint)
    if origin in {Union, UnionType}:
        return any(_accepts(value, part, info) for part in args)
    if origin is Literal:
        return any(type(value) is type(choice) and value == choice for choice in args)
    if origin is tuple:
        parts = args[:1] * len(value) if args[1:] == (...,) and isinstance(value, tuple) else args
        return (
            isinstance(value, tuple)
            and len(value) == len(parts)
            and all(_accepts(part, kind, info) for part, kind in zip(value, parts, strict=True))
        )
    if hint in {int, float}:
        if isinstance(value, bool) or not isinstance(value, Real) or not isfinite(value):
            return False
        whole = hint is float or value % 1 == 0
        return whole and all(_COMPARE[name](value, b) for name, b in info.bounds.items())
    if hint is Path:
        return isinstance(value, str | PathLike)
    return not isinstance(hint, type) or isinstance(value, hint)


_COMPARE = {
    "ge": lambda value, bound: value >= bound,
    "gt": lambda value, bound: value > bound,
    "le": lambda value, bound: value <= bound,
    "lt": lambda value, bound: value < bound,
}
_WORDS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}


def _describe(hint: Any, info: OptionInfo) -> str:  # noqa: ANN401
    """Describe the values that an option takes."""
    origin, args = get_origin(hint), get_args(hint)
    if origin in {Union, UnionType}:
        return " or ".join(_describe(part, info) for part in args)
    if origin is Literal:
        return " or ".join(map(repr, args))
    if origin is tuple:
        count = "any number" if args[1:] == (...,) else str(len(args))
        return f"a tuple of {count}, each {_describe(args[0], info)}"
    if hint is NoneType:
        return "None"
    if hint is bool:
        return "True or False"
    if hint in {int, float}:
        kind = "a whole number" if hint is int else "a number"
        bounds = " and ".join(f"{_WORDS[name]} {b:g}" for name, b in info.bounds.items())
        return f"{kind} {bounds}" + f" [{info.unit}]" * bool(info.unit)
    return f"a {getattr(hint, '__name__', hint)}"


def reject_unknown(given: Iterable[str], allowed: Iterable[str], function: str) -> None:
    """Raise `OptionError` for a keyword that a function does not have; name the closest one."""
    names = sorted(allowed)
    for name in sorted(set(given).difference(names)):
        close = get_close_matches(name, names, 1)
        hint = f"did you mean {close[0]}?" if close else f"choose one of {', '.join(names)}."
        raise OptionError(f"{name} is not an option of {function}; {hint}")


def in_radians(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values that are not None, with angles named ``*_deg`` in radians and named without it.

    Whole turns of a heading are left out.
    """
    return {
        name.removesuffix("_deg"): (
            radians(value % 360.0 if name == "heading_deg" else value)
            if name.endswith("_deg") else value
        )
        for name, value in values.items() if value is not None
    }  # fmt: skip


def write_table(owner: type) -> str:
    """Return a Markdown table of the options of a dataclass: name, default, values, help.

    Options that a base class defines stand in the table of the base class alone.
    """
    bases = [base for base in owner.__bases__ if hasattr(base, "__dataclass_fields__")]
    inherited = {entry.name for base in bases for entry in options_of(base)}
    rows = [
        f"| `{name}` | `{_shorten(default)}` | {_describe(hint, info)} | {info.help} |"
        for name, default, hint, info in options_of(owner)
        if name not in inherited
    ]
    header = f"| `{owner.__name__}` | default | values | meaning |"
    return "\n".join([header, "|---|---|---|---|", *rows])


def _shorten(default: Any) -> str:  # noqa: ANN401
    if isinstance(default, tuple):
        return f"({', '.join(map(_shorten, default))}{',' * (len(default) == 1)})"
    if isinstance(default, float):
        return f"{default:g}"
    if hasattr(default, "__dataclass_fields__"):
        cls: Any = type(default)
        plain, names = cls(), [entry.name for entry in options_of(cls)]
        changed = [n for n in names if getattr(default, n) != getattr(plain, n)]
        values = (f"{name}={_shorten(getattr(default, name))}" for name in changed)
        return f"{cls.__name__}({', '.join(values)})"
    return repr(default)
