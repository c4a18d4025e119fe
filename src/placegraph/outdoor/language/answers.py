"""Reasons and questions in the language of a text, by one table (``answers.toml``)."""

from __future__ import annotations

import re
import tomllib
from functools import cache
from importlib.resources import files


def translate(text: str, code: str) -> str:
    """Translate the sentences of a reason or a question; those that the table lacks stay English."""
    for pattern, sentence in _sentences(code):
        found = pattern.search(text)
        if found:
            text = text[: found.start()] + sentence.format(*found.groups()) + text[found.end() :]
    joined = "” and “"
    return text.replace(joined, translate_option(joined, code))


def translate_option(option: str, code: str) -> str:
    """Translate an option of a question; a name stays as it is."""
    return read_answers().get(code, {}).get(option, option)


@cache
def read_answers() -> dict[str, dict[str, str]]:
    """Read sentences and options of every language of the table, by what they are in English."""
    return tomllib.loads((files(__package__) / "answers.toml").read_text("utf-8"))


@cache
def _sentences(code: str) -> list[tuple[re.Pattern[str], str]]:
    """Return patterns of English sentences, the longest first, and their translations."""
    table = read_answers().get(code, {})
    found = sorted((e for e in table if e[-1] in ".?"), key=len, reverse=True)
    return [(re.compile(re.escape(e).replace(r"\{\}", "(.+?)")), table[e]) for e in found]
