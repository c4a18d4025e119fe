"""Check that no sentence of the docs is too long.

usage: python tools/check_sentences.py    (in the repository's root; exit code 1 where one is)
"""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

DOCS = (
    "README.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "CHANGELOG.md",
    "docs",
    "packages",
    "lab/README.md",
)
LONGEST_SENTENCE = 35  # words


def _files() -> Iterator[Path]:
    for root in map(Path, DOCS):
        yield from [root] if root.is_file() else sorted(root.rglob("*.md"))


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences of Markdown: without code, formulas and targets of links."""
    text = re.sub(r"^\s*(```|~~~).*?^\s*\1", "\n\n", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"<!--.*?-->|\$\$.*?\$\$", "\n\n", text, flags=re.DOTALL)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", re.sub(r"`[^`]*`", "code", text))
    for block in re.split(r"\n\s*\n|\n(?=\s*(?:[-*+]|\d+\.|\||#|>|!!!|:::)\s?)|\|", text):
        yield from re.split(r"(?<=[.!?])[\"')*_]*\s+", " ".join(block.split()))


def check_docs() -> Iterator[str]:
    """Yield a line for each sentence of the docs that is too long."""
    for path in _files():
        for sentence in sentences(path.read_text("utf-8")):
            words = [w for w in sentence.split() if re.search(r"\w", w)]
            if len(words) > LONGEST_SENTENCE:
                yield f"{path}: {len(words)} words: {' '.join(words[:9])} ..."


if __name__ == "__main__":
    found = list(check_docs())
    sys.stdout.write("\n".join(found or ["sentences: no finding"]) + "\n")
    sys.exit(bool(found))
