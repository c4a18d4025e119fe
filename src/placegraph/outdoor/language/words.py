"""Normal forms of words: of nouns (normal), of names (tokens), and what a vocabulary and a map offer."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Protocol

from placegraph.language.text import fold_case


def _read_pairs(text: str) -> dict[str, str]:
    """Read "from>to" pairs of words; an underscore stands for a space."""
    return dict(pair.replace("_", " ").split(">") for pair in text.split())


def read_words(text: str) -> frozenset[str]:
    """Return the words of a list written with spaces."""
    return frozenset(text.split())


ARTICLES = read_words("""
    a an the some any der die das den dem des ein eine einen einem le la les l un une du el los
    las una unos unas il lo gli i uno o os as um uma de het een en et det els
""")
"""Articles that may stand before a noun; English first, then languages quoted in English text."""

_POSSESSIVE = re.compile(r"'s\b|(?<=s)'(?!\w)")
_SEPARATORS = re.compile(
    r"[^\w\u0300-\u036f\u0591-\u05c7\u0610-\u061a\u064b-\u0670\u0900-\u109f\u1780-\u17ff]+|_"
)
"""Pattern between words; combining marks of Hebrew, Arabic, Indic and Thai letters are no separators."""
_FOLDED_LETTERS = str.maketrans(
    {**dict(zip("ıςłøđð", "iσlodd", strict=True)), "þ": "th", "æ": "ae", "œ": "oe", "ß": "ss"}
)
_SPELLING = _read_pairs("""
    center>centre centers>centres theater>theatre theaters>theatres amphitheater>amphitheatre
    jewellery>jewelry jeweller>jeweler jewellers>jewelers tire>tyre tires>tyres curb>kerb
    curbs>kerbs neighborhood>neighbourhood neighborhoods>neighbourhoods harbor>harbour
    harbors>harbours parlour>parlor gray>grey catalog>catalogue storey>story
    multistorey>multi_story yoghurt>yogurt doughnut>donut doughnuts>donuts labor>labour
    organisation>organization traveler>traveller counseling>counselling
    pediatrician>paediatrician licence>license bike>bicycle bikes>bicycles
""")
"""Words with two spellings or an everyday short form, so that "bike rental" needs no entry."""

_IRREGULAR = _read_pairs("""
    people>person children>child men>man women>woman feet>foot teeth>tooth leaves>leaf
    shelves>shelf buses>bus busses>bus gases>gas heroes>hero potatoes>potato quizzes>quiz
    mice>mouse geese>goose
""")
_UNCHANGED = read_words("""
    news series species swiss chess canvas christmas lens perhaps always across texas kansas les
    paris reis mars gross
""")


def normal(phrase: str) -> str:
    """Return the normal form: case, punctuation, possessives and spelling variants removed.

    Applying it twice changes nothing.
    """
    phrase = phrase.replace("İ", "i").lower()
    if not phrase.isascii():
        phrase = unicodedata.normalize("NFKC", phrase).replace("’", "'").lower()
    if "'" in phrase:
        phrase = _POSSESSIVE.sub("", phrase)
    if "&" in phrase or "+" in phrase:
        phrase = phrase.replace("&", " and ").replace("+", " and ")
    words = _SEPARATORS.sub(" ", phrase).split()
    return " ".join([_SPELLING.get(word, word) for word in words])


def singular(phrase: str) -> str:
    """Return a normal form with every word in the singular, by the rules of English."""
    return " ".join([_singular(word) for word in phrase.split(" ")])


def _singular(word: str) -> str:
    if not word.endswith("s"):
        return _IRREGULAR.get(word, word)
    if word in _IRREGULAR:
        return _IRREGULAR[word]
    if len(word) < 4 or word.endswith(("ss", "us", "is")) or word in _UNCHANGED:
        return word
    if word.endswith("ies") and len(word) > 4:
        return word[:-3] + "y"
    if word.endswith(("ches", "shes", "sses", "xes", "zzes")):
        return word[:-2]
    return word[:-1]


def fold_diacritics(phrase: str) -> str:
    """Return a normal form without diacritics: "café" -> "cafe", "kırtasiye" -> "kirtasiye"."""
    if phrase.isascii():
        return phrase
    parts = unicodedata.normalize("NFKD", fold_case(phrase).translate(_FOLDED_LETTERS))
    bare = "".join([letter for letter in parts if not unicodedata.combining(letter)])
    return unicodedata.normalize("NFC", bare)


_SOUNDS = {
    "es": "v>b z>s ce>se ci>si ll>i y>i h> qu>k x>s", "pt": "z>s ce>se ci>si ss>s h> qu>k",
    "fr": "ph>f qu>k ss>s", "it": "ch>k h>", "de": "th>t ie>i dt>t ck>k", "nl": "ij>ei dt>t ck>k",
    "pl": "rz>z ch>h w>v", "tr": "v>f",
}  # fmt: skip
"""Letters that sound alike in a language and are often mixed up."""


def spell_sounds(word: str, code: str) -> str:
    """Return a word of a language without diacritics and with one letter for each of its sounds.

    Words that sound alike are the same: in Spanish "serca" and "cerca".
    """
    word = fold_diacritics(word)
    for pair in _SOUNDS.get(code, "").split():
        letters, _, sound = pair.partition(">")
        word = word.replace(letters, sound)
    return word


_ENDINGS = ("ed", "ing", "ly", "er", "est", "es", "s", "al", "ive")
ALIKE = 0.85
"""Similarity (Jaro-Winkler) from which a known word is worth suggesting."""
LONG = 8
"""Letters of words in which two letters may differ."""


def correct_word(form: str, choices: Sequence[str]) -> tuple[str, float] | None:
    """Return the choice that a word is a misspelling of, and how near it is (Jaro-Winkler)."""
    from rapidfuzz import process
    from rapidfuzz.distance import OSA, JaroWinkler

    most = 2 if len(form) >= LONG else 1
    near = process.extract(form, choices, scorer=OSA.distance, score_cutoff=most, limit=None)
    meant = [word for word, *_ in near if _is_slip(form, word)]
    found = [(word, JaroWinkler.similarity(form, word)) for word in meant]
    return max(found, key=lambda pair: pair[1], default=None)


def find_similar(form: str, choices: Sequence[str]) -> list[str]:
    """Return at most two choices that a word looks like, the likest first."""
    from rapidfuzz import process
    from rapidfuzz.distance import JaroWinkler

    scorer = JaroWinkler.similarity
    near = process.extract(form, choices, scorer=scorer, score_cutoff=ALIKE, limit=8)
    return list(dict.fromkeys(word for word, *_ in near))[:2]


def _is_slip(typed: str, meant: str) -> bool:
    """Tell whether one word may be a misspelling of another.

    In a short word a letter replaced is another word more often than a slip ("like", "line"), and
    so is another ending ("poster", "posted").
    """
    from rapidfuzz.distance import Prefix

    if typed[0] != meant[0] or singular(typed) == singular(meant):
        return False
    replaced = len(typed) == len(meant) and sorted(typed) != sorted(meant)
    if replaced and len(typed) < LONG - 1:
        return False
    stem = Prefix.similarity(typed, meant)
    return not any(typed[stem:].endswith(ending) and len(typed) - stem <= 4 for ending in _ENDINGS)


def beginnings(phrases: Iterable[str]) -> frozenset[str]:
    """Return all proper beginnings of phrases, word by word."""
    found = set()
    for phrase in phrases:
        at = phrase.find(" ")
        while at > 0:
            found.add(phrase[:at])
            at = phrase.find(" ", at + 1)
    return frozenset(found)


class NameFinder(Protocol):
    """The proper names of a map."""

    def longest_name(self, tokens: Sequence[str], start: int) -> int:
        """Count the words of the longest name that begins at `start`; 0 for none.

        Words are in the normal form of `tokens`.
        """

    def find_within(self, text: str) -> Iterable[tuple[str, str]]:
        """Return names that words of a text begin with, and the rest of the last word."""

    def find_sites(self, text: str) -> list[tuple[int, int]]:
        """Find stretches (start, end) of a text that name a crossing or a house by its streets."""

    def closest_name(self, phrase: str) -> tuple[str, float] | None:
        """Return the most similar name and its similarity in [0, 1], or None."""


_NAME_SPELLING = _read_pairs("""
    street>st saint>st ste>sainte str>st avenue>ave avenida>ave av>ave boulevard>blvd boul>blvd bd>blvd
    bulvari>blvd bulvar>blvd road>rd drive>dr doctor>dr lane>ln place>pl square>sq parkway>pkwy highway>hwy
    terrace>ter mount>mt fort>ft building>bldg centre>center ctr>center cntr>center
    univ>university uni>university co>company bros>brothers sts>saints hts>heights jct>junction
    jctn>junction intl>international natl>national hosp>hospital apts>apartments cad>caddesi
    cd>caddesi sok>sokak sk>sokak sokagi>sokak ier>1er ul>ulica pque>parque ул>улица вул>вулиця
    пр>проспект просп>проспект пл>площадь площа>площадь n>north s>south e>east w>west theatre>theater
    et>and und>and
    first>1st second>2nd third>3rd fourth>4th fifth>5th sixth>6th seventh>7th eighth>8th
    ninth>9th tenth>10th eleventh>11th twelfth>12th thirteenth>13th fourteenth>14th
    fifteenth>15th sixteenth>16th seventeenth>17th eighteenth>18th nineteenth>19th
    twentieth>20th ביס>בית_ספר ביהס>בית_ספר ביכ>בית_כנסת ביהכ>בית_כנסת ביח>בית_חולים
    ביהח>בית_חולים קופח>קופת_חולים תת>תלמוד_תורה שד>שדרות רח>רחוב בינל>בינלאומי
""")
"""Short forms in names; "St" is a saint as often as a street: both sides of a comparison read it alike."""
COMPASS = frozenset(
    ("north", "south", "east", "west", "northeast", "northwest", "southeast", "southwest")
)
"""Points of the compass, as `tokens` writes them: "East Street" is not "West Street"."""
ROADS = frozenset(
    ("st", "ave", "rd", "blvd", "ln", "dr", "hwy", "pl", "ter", "alley", "pkwy", "sokak", "caddesi")
)
"""Last words of names of roads, as `tokens` writes them."""
TYPES = ROADS | read_words("""
    way court crescent cres cir circle sq square mews quay walk row highway expressway rue calle via
    viale corso piazza avenida rua ulica ul улица ул проспект вулиця plaza paseo strasse weg gasse
    straat cad jalan alameda carrer rambla רחוב שדרות דרך شارع
""")
"""Words in names of streets that say that it is one."""
JOINS = read_words("and & @ / at near und y et och ja ve и і corner ecke esquina con com en و")
"""Words between the names of two streets that cross."""
BETWEEN = read_words("between zwischen entre tra fra mellan tussen")
CORNERS = read_words("""
    corner intersection crossing junction crossroads corners ecke kreuzung coin angle carrefour
    esquina cruce cruzamento angolo incrocio hoek kruising korsning hornet kulma risteys rog kosesi угол
    langle allangolo углу перекресток перекрестке تقاطع
""")
SIDES = COMPASS | read_words("ne nw se sw st northeastern northwestern southeastern southwestern")
"""Words between "the" and "corner of" a crossing."""
PLURALS = _read_pairs("streets>st avenues>ave roads>rd drives>dr sts>st")
"""Words for several streets: "10th and 11th Avenues"."""
SMALL = read_words("""
    the a an of and at in on for by de la le les du des d l del della di da do dos el los las y
    e der die das dem den von vom zu zum zur am im van het רחוב شارع
""")
"""Words of names that tell no two names apart."""
_ORDINAL = re.compile(r"(\d{1,9})(?:st|nd|rd|th|d)")
_ARTICLE = re.compile(r"ה[א-ת]{3}|ال\w{2}")
"""Article that is written onto a word; behind a prefix a text lacks it."""
_DOUBLED = re.compile(r"([יו])\1")
"""Hebrew letters that are written once or twice: "ספריית", "ספרית"."""
_NAME_WORD = re.compile(r"[^\W_]+(?:(?:['’`´׳״]|(?<=[\u05d0-\u05ea])(?:\"|''))[^\W_]+)*|&")


@lru_cache(maxsize=1 << 16)
def fold(word: str) -> str:
    """Return the normal form of one word of a name: "Theatre" -> "theater", "N" -> "north"."""
    if word == "&":
        return "and"
    word = word.casefold()
    if not word.isalnum() or not word.isascii():
        parts = unicodedata.normalize("NFKD", fold_case(word).translate(_FOLDED_LETTERS)).casefold()
        word = "".join([c for c in parts if c.isalnum()])
        if _ARTICLE.match(word):
            word = word[1:] if word[0] == "ה" else word[2:]
        word = _DOUBLED.sub(r"\1", word)
    if word[0:1].isdigit() and (number := _ORDINAL.fullmatch(word)):
        return ordinal(int(number[1]))  # "43th"
    if word.endswith("strasse") and len(word) > 7:
        return word[:-4]  # "Hauptstr."
    return _NAME_SPELLING.get(word, word)


_LATIN = str.maketrans(
    _read_pairs("""
    а>a б>b в>v г>g ґ>g д>d е>e є>ye ж>zh з>z и>i і>i й>y к>k л>l м>m н>n о>o п>p р>r с>s т>t у>u ф>f
    х>kh ц>ts ч>ch ш>sh щ>shch ъ> ы>y ь> э>e ю>yu я>ya α>a β>v γ>g δ>d ε>e ζ>z η>i θ>th ι>i κ>k λ>l
    μ>m ν>n ξ>x ο>o π>p ρ>r σ>s τ>t υ>y φ>f χ>ch ψ>ps ω>o
""")
)


def transliterate(words: str) -> str:
    """Return folded words with Cyrillic and Greek letters as Latin ones: "невскии" -> "nevsky"."""
    return words.replace("ии", "y").translate(_LATIN)


def ordinal(number: int) -> str:
    """Write a number as streets are counted: "2nd", "11th", "43rd"."""
    tens, ones = divmod(number, 10)
    ending = {1: "st", 2: "nd", 3: "rd"}.get(ones, "th") if tens % 10 != 1 else "th"
    return f"{number}{ending}"


def tokens(text: str) -> list[str]:
    """Return the words of a name or a text in the normal form in which the two meet.

    Lower-case, without diacritics, apostrophes, punctuation and underscores, and with one
    spelling for what is often shortened: ``"Ripley's_Aquarium"`` -> ``["ripleys", "aquarium"]``,
    ``"E Carson Street"`` -> ``["east", "carson", "st"]``.
    """
    found = [w for written in _NAME_WORD.findall(text) for w in fold(written).split(" ") if w]
    for i, word in enumerate(found[1:]):
        if word in ("st", "ave") and len(found[i]) < 4 and found[i].isdecimal():
            found[i] = ordinal(int(found[i]))  # "East 40 Street"
    return found


def normalise(text: str) -> str:
    """Return the `tokens` of a text, joined by spaces."""
    return " ".join(tokens(text))
