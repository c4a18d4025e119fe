"""Errors: one root, exit codes that scripts may rely on."""

import re
from pathlib import Path

import pytest

from placegraph import errors
from placegraph.errors import PlacegraphError

CONVENTIONS = Path(__file__).resolve().parents[1] / "docs" / "conventions.md"

# Written down on purpose: changing one of these breaks other people's scripts.
EXIT_CODES = {
    "PlacegraphError": 1,
    "InputError": 3,
    "MapError": 4,
    "MapLockedError": 5,
    "DescriptionError": 6,
    "OptionError": 7,
    "MissingExtraError": 8,
    "ServiceError": 9,
    "StoreError": 10,
    "IncompleteStoreError": 11,
    "RequestError": 12,
    "GeoPoseError": 13,
}


def classes():
    found = [c for c in vars(errors).values() if isinstance(c, type)]
    return [c for c in found if issubclass(c, PlacegraphError)]


def test_exit_codes_are_stable_and_complete():
    assert {c.__name__: c.exit_code for c in classes()} == EXIT_CODES


def test_exit_codes_are_documented():
    rows = re.findall(r"^\| (\d+) \|[^|]*\| `(\w+)` \|", CONVENTIONS.read_text(), re.MULTILINE)
    assert {name: int(code) for code, name in rows} == EXIT_CODES


@pytest.mark.parametrize("error", classes(), ids=lambda c: c.__name__)
def test_every_error_is_caught_by_the_root_and_keeps_its_sentence(error):
    with pytest.raises(PlacegraphError, match=r"^name the file$"):
        raise error("name the file")
    assert error.__doc__


def test_errors_are_also_what_python_would_raise():
    assert issubclass(errors.OptionError, ValueError)
    assert issubclass(errors.MissingExtraError, ImportError)
    assert issubclass(errors.MapLockedError, errors.MapError)
