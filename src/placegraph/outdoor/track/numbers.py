"""Numbers and times in words: "two hundred and fifty metres", "for two minutes"."""

from __future__ import annotations

import re

_UNITS = {
    "zero": 0, "one": 1, "two": 2, "three": 3, "four": 4, "five": 5, "six": 6, "seven": 7,
    "eight": 8, "nine": 9, "ten": 10, "eleven": 11, "twelve": 12, "thirteen": 13, "fourteen": 14,
    "fifteen": 15, "sixteen": 16, "seventeen": 17, "eighteen": 18, "nineteen": 19,
}  # fmt: skip
_TENS = {
    "twenty": 20, "thirty": 30, "forty": 40, "fifty": 50, "sixty": 60, "seventy": 70,
    "eighty": 80, "ninety": 90,
}  # fmt: skip
_POWERS = {"hundred": 100, "thousand": 1000}
_WORD = "|".join(sorted((*_UNITS, *_TENS, *_POWERS), key=len, reverse=True))
_RUN = re.compile(
    rf"\b(?:(?:a|an)\s+(?=hundred|thousand))?(?:{_WORD})(?:(?:[\s-]+(?:and\s+)?)(?:{_WORD}))*\b",
    re.IGNORECASE,
)

_AMOUNT = r"""(?:\d+(?:[.,]\d+)?(?:\s*(?:[-–]|to|or)\s*\d+)? | (?:a\s+)?(?:couple(?:\s+of)?|few)
    | several | half(?:\s+of)?\s+an? | (?:a\s+)?quarter\s+of\s+an? | an?)"""
DURATION = rf"""\b(?:(?:about|around|roughly|some|almost|nearly|another)\s+)?
    {_AMOUNT}(?:\s+and\s+a\s+half)?(?:(?<=\d)\s*|[\s-]+)
    (?:seconds?|secs?|min(?:ute)?s?|hours?|hrs?|h)(?:\s+and\s+a\s+half)?(?![\w'])(?!['’]?[\s-]+walk)"""
"""Pattern of a duration (verbose, case ignored)."""
_SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0}
_FEW = {"couple": 2.0, "few": 3.0, "several": 4.0, "quarter": 0.25}


def in_digits(text: str) -> str:
    """Return a text with its numbers in digits: "two hundred and fifty" becomes "250"."""
    return _RUN.sub(lambda match: str(_number(match.group())), text)


def _number(written: str) -> int:
    total = group = 0
    for word in re.findall(r"[a-z]+", written.lower()):
        if word == "hundred":
            group = max(group, 1) * 100
        elif word == "thousand":
            total, group = total + max(group, 1) * 1000, 0
        else:
            group += _UNITS.get(word, 0) + _TENS.get(word, 0)
    return total + group


def seconds(written: str) -> float:
    """Seconds of a duration that `DURATION` matched."""
    text = written.lower()
    words = re.findall(r"[a-z]+", text)
    unit = next(w for w in reversed(words) if w not in ("and", "a", "half"))
    numbers = [float(n.replace(",", ".")) for n in re.findall(r"\d+(?:[.,]\d+)?", text)]
    amount = (
        sum(numbers) / len(numbers)
        if numbers
        else next((_FEW[w] for w in words if w in _FEW), 0.0 if "half" in words else 1.0)
    )
    if "half" in words:
        amount += 0.5
    if not numbers and re.search(r"and\s+a\s+half", text):
        amount = 1.5  # "an hour and a half"
    return amount * _SECONDS[unit[0]]
