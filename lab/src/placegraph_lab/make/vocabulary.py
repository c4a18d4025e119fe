"""Make the lexicons of placegraph's vocabulary from the iD presets.

They come from the npm package @openstreetmap/id-tagging-schema (ISC licence), those that ship from
its version 6.19.2. The same package gives the same bytes.
"""

from __future__ import annotations

import json
import lzma
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from placegraph.errors import InputError
from placegraph.outdoor.language.vocabulary.tables import DETAIL, LETTERS, ObjectTable, read_objects
from placegraph.outdoor.language.words import fold_diacritics, normal, singular

ENGLISH = ("en", "en-GB", "en-AU", "en-CA", "en-IN", "en-NZ", "en-US")
# fmt: off
WORLD = (
    "ar", "bg", "ca", "cs", "da", "de", "el", "es", "et", "eu", "fi", "fr", "gl", "he", "hr", "hu",
    "id", "is", "it", "ja", "ko", "lt", "lv", "mk", "nl", "no", "pl", "pt", "pt-BR", "ro", "ru",
    "sk", "sl", "sr", "sv", "th", "tr", "uk", "vi", "zh-CN", "zh-TW",
)
# fmt: on
GENERIC = 0.4  # weight of leisure=pitch for "tennis court", beside sport=tennis
VAGUE = 0.6  # factor for a preset with tags that are not worth naming ("clinic for dialysis")

Entries = dict[str, dict[tuple[int, str], set[str]]]  # word -> (preset, kind) -> languages


def labels_of(tags: dict[str, str], objects: ObjectTable) -> str:
    """Labels of a preset with weights, as a lexicon writes them; empty if it is no object."""
    names = [f"{key}={value}" for key, value in tags.items() if objects.names(f"{key}={value}")]
    makers = [name for name in names if name.partition("=")[0] in objects.keys]
    details = [name for name in names if name not in makers]
    if not makers:
        return ""
    factor = 1.0 if len(names) == len(tags) else VAGUE
    weights = dict.fromkeys(makers, factor * (GENERIC if details else 1.0))
    weights |= dict.fromkeys(details, factor)
    return " ".join(
        name if weight == 1.0 else f"{name}@{weight:.2g}" for name, weight in weights.items()
    )


def variants(name: str) -> Iterator[str]:
    """Shorter ways to say a preset's name.

    >>> list(variants("Gym / Fitness Center"))
    ['Gym', 'Fitness Center', 'Gym Center']
    >>> list(variants("Train Station (Halt / Request)"))
    ['Train Station']
    """
    bare = re.sub(r"\s*[(（].*?[)）]\s*", " ", name).strip()
    parts = [part.strip() for part in re.split(r"\s+/\s+|\s*／\s*", bare)]
    if len(parts) == 1:
        if bare != name:
            yield bare
        return
    head, tail = parts[0].split()[:-1], parts[-1].split()[1:]
    for part in parts:
        if not head or part == parts[0] or len(part.split()) > 1:
            yield part
        if head and part != parts[0]:
            yield " ".join([*head, part])
        if tail and part != parts[-1]:
            yield " ".join([part, *tail])


def list_forms(texts: dict[str, str], *, longest: int) -> Iterator[tuple[str, str]]:
    """Yield the normal forms of a preset's name, aliases and terms, with their kinds."""
    name = texts.get("name", "")
    aliases = (texts.get("aliases") or "").split("\n")
    shorter = list(variants(name))
    for kind, words, limit in (
        ("n", [*shorter, name][:1], 5),
        ("a", [name, *aliases], 5),
        ("v", [*shorter, *(short for word in aliases for short in variants(word))], 5),
        ("t", (texts.get("terms") or "").split(","), longest),
    ):
        for word in words:
            form = normal(word)
            if form and not word.strip().startswith("<") and len(form.split()) <= limit:
                yield form, kind


class Maker:
    """Lexicon maker of the package's presets and translations."""

    def __init__(self, package: Path, objects: ObjectTable) -> None:
        self.package, self.objects = package, objects
        presets = self.read("presets")
        labels = {
            name: labels_of(preset.get("tags", {}), objects)
            for name, preset in presets.items()
            if not name.startswith("@")
        }
        self.labels = {name: text for name, text in labels.items() if text}
        self.exact = {
            name
            for name in self.labels
            if self.labels[name].count("=") == len(presets[name]["tags"])
        }

        self.texts = {language: self.translation(language) for language in (*ENGLISH, *WORLD)}
        self.donor = self.donors()

    def translation(self, language: str) -> dict[str, dict[str, str]]:
        """Names, aliases and terms of the presets in one language."""
        body = self.read(f"translations/{language}")[language]
        found: dict[str, dict[str, str]] = body.get("presets", {}).get("presets", {})
        return found

    def donors(self) -> dict[str, str]:
        """Preset whose texts an unnamed preset takes: education/school for amenity/school."""
        named: dict[str, list[str]] = defaultdict(list)
        for name in self.labels:
            if self.texts["en"].get(name, {}).get("name") and not name.startswith("building/"):
                named[name.rpartition("/")[2]].append(name)
        last = {name: named[name.rpartition("/")[2]] for name in self.labels}
        return {
            name: donors[0] if len(donors) == 1 and not self.texts["en"].get(name) else name
            for name, donors in last.items()
        }

    def read(self, name: str) -> Any:  # noqa: ANN401  # JSON
        """Read a file of the package's dist folder."""
        path = self.package / "dist" / f"{name}.min.json"
        try:
            return json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(
                f"{path}: {error}. Give the folder of the unpacked npm package"
                " @openstreetmap/id-tagging-schema."
            ) from error

    def lexicon(
        self, languages: Sequence[str], names: Iterable[str], *, longest: int, shortest: int
    ) -> tuple[list[str], Entries]:
        """Collect labels of the presets `names`, and the words for them.

        Terms of more than `longest` words are left out, and Latin words of fewer than `shortest`
        letters.
        """
        number: dict[str, int] = {}
        entries: Entries = defaultdict(lambda: defaultdict(set))
        names = sorted(names, key=lambda name: name.count("/"))  # plain presets name their labels
        for language, letter in zip(languages, LETTERS, strict=False):
            texts = self.texts[language]
            known: dict[int, set[str]] = defaultdict(set)
            for name in names:
                preset = number.setdefault(self.labels[name], len(number))
                first = preset not in known
                for form, kind in list_forms(texts.get(self.donor[name], {}), longest=longest):
                    if form not in known[preset] and not (form.isascii() and len(form) < shortest):
                        known[preset].add(form)
                        entries[form][preset, kind if first else kind.replace("n", "a")].add(letter)
        return list(number), entries

    def english(self) -> str:
        """Make the English lexicon: with raw tag values, and every phrase in the singular too."""
        labels, entries = self.lexicon(ENGLISH, self.labels, longest=5, shortest=2)
        number = {label: at for at, label in enumerate(labels)}
        for text in labels[:]:
            for label in (part.partition("@")[0] for part in text.split()):
                value = label.partition("=")[2]
                if value in ("*", "yes") or self.objects.rule(label).role == DETAIL:
                    continue
                at = number.setdefault(label, len(number))
                entries[normal(value)][at, "r"].add("A")
        flat: Entries = defaultdict(lambda: defaultdict(set))
        for change in (fold_diacritics, lambda word: singular(fold_diacritics(word))):
            for word in [
                word for word in entries if change is fold_diacritics or change(word) not in flat
            ]:
                for entry, spoken in entries[word].items():
                    flat[change(word)][entry] |= spoken
        return write(ENGLISH, list(number), flat)

    def world(self) -> str:
        """Make the lexicon of all other languages."""
        exact = [name for name in self.labels if name in self.exact]
        return write(WORLD, *self.lexicon(WORLD, exact, longest=2, shortest=2))


def write(languages: Sequence[str], labels: list[str], entries: Entries) -> str:
    """Write a lexicon as text; of several kinds of one preset, the best is kept."""
    lines = []
    for word in sorted(entries, key=lambda word: (fold_diacritics(word), word)):
        found = sorted(
            f"{preset}{kind}{''.join(sorted(spoken))}"
            for (preset, kind), spoken in entries[word].items()
        )
        lines.append(f"{word}\t{' '.join(found)}")
    return "\n".join(["\t".join(languages), "\t".join(labels), *lines]) + "\n"


def write_lexicons(package: Path, out: Path, report: Callable[[str], None]) -> None:
    """Make both lexicons of the unpacked package in a folder, and copy the licence.

    Raises `InputError` where the package is another folder.
    """
    maker = Maker(package, read_objects())
    out.mkdir(parents=True, exist_ok=True)
    for name, text in (("english", maker.english()), ("world", maker.world())):
        path = out / f"{name}.tsv.xz"
        path.write_bytes(
            lzma.compress(text.encode(), preset=9 | lzma.PRESET_EXTREME, check=lzma.CHECK_CRC32)
        )
        report(f"{path}: {text.count(chr(10)) - 2} words, {path.stat().st_size} bytes")
    licence = (package / "LICENSE.md").read_text(encoding="utf-8")
    (out / "LICENSE-id-tagging-schema.md").write_text(licence, encoding="utf-8")
