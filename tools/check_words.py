"""Check how code and docs are worded: openings of docstrings, names, length of sentences.

usage: python tools/check_words.py    (in the repository's root; exit code 1 where something is found)
"""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

CODE = ("src", "packages", "lab/src", "examples")
DOCS = (
    "README.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "CHANGELOG.md",
    "docs",
    "packages",
    "lab/README.md",
)
ODD_OPENINGS = frozenset({"What", "Where", "How", "Who", "Whatever", "Of", "As", "Such"})
ODD_SHARE = 0.005  # of all docstrings
LONGEST_SENTENCE = 35  # words
# Bare participles, pronouns and metaphors; docs/glossary.md has the terms that stand instead.
OLD_NAMES = frozenset(Path(__file__).with_name("old_names.txt").read_text("utf-8").split())
PARTICIPLE = re.compile(
    "[a-z]*(ed|wn|en|elt|ost|ung|aid|ept)|built|done|found|gone|held|hung|led|left|made|met|seen|sent|sold|told|torn"
    "|all|each|mine|none|others|ours|own|some|that|there|this|those"
)
EXCEPTIONS: dict[str, str] = {  # names that stay, each with its reason
    "anchored": "documented method of SceneMap",
    "answered": "member of WorldEstimate",
    "between": "preposition, the name of this function in GTSAM",
    "others": "option --others of training, key of its results",
    "published": "documented recipe of FilterOptions",
    "sight": "column of the table of words of a sharded world, option of a table",
    "things": "key of a question in the server's JSON",
    "told": "key of the summary of a ROS stream",
    "updated": "documented method of SceneMap",
}
NOUNS = ("cost", "feed", "Feed", "host", "markdown", "speed", "Town")
EXCEPTIONS |= dict.fromkeys((*NOUNS, "embed", "listen", "open", "shorten"), "no participle")


def _files(roots: tuple[str, ...], suffix: str) -> Iterator[Path]:
    for root in map(Path, roots):
        yield from [root] if root.is_file() else sorted(root.rglob(f"*{suffix}"))


def _names(node: ast.AST) -> Iterator[str]:
    """Yield the names that a class or function defines: its own, its parameters, its fields."""
    if isinstance(node, ast.ClassDef):
        yield node.name
        fields = (f.target for f in node.body if isinstance(f, ast.AnnAssign))
        yield from (f.id for f in fields if isinstance(f, ast.Name))
    elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        yield node.name
        yield from (a.arg for a in [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs])


def participles(node: ast.Module | ast.ClassDef) -> Iterator[tuple[int, str]]:
    """Yield line and name of public classes, functions and methods that are a participle or pronoun."""
    for child in node.body:
        if isinstance(child, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            is_property = any("property" in ast.unparse(d) for d in child.decorator_list)
            if PARTICIPLE.fullmatch(child.name[0].lower() + child.name[1:]) and not is_property:
                yield child.lineno, child.name
        if isinstance(child, ast.ClassDef):
            yield from participles(child)


def check_code() -> Iterator[str]:
    """Yield a line for each old or bare name, and for each odd docstring where they are too many."""
    count, odd = 0, []
    for path in _files(CODE, ".py"):
        tree = ast.parse("" if "tests" in path.parts else path.read_text("utf-8"))
        for line, name in participles(tree):
            if name not in EXCEPTIONS:
                yield f"{path}:{line}: {name}: bare participle or pronoun; say verb and object, or a noun"
        for node in ast.walk(tree):
            place = f"{path}:{getattr(node, 'lineno', 1)}"
            for name in _names(node):
                if name.strip("_").lower() in OLD_NAMES and name not in EXCEPTIONS:
                    yield f"{place}: {name}: old name; docs/glossary.md has the field's"
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module):
                opening = (ast.get_docstring(node) or " ").split(maxsplit=1)[:1]
                count += len(opening)
                if opening and opening[0].strip(".,:`\"'") in ODD_OPENINGS:
                    odd.append(f"{place}: docstring opens with {opening[0]}: use a verb or a noun")
    if len(odd) > ODD_SHARE * count:
        yield from odd


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences of Markdown: without code, formulas and targets of links."""
    text = re.sub(r"^\s*(```|~~~).*?^\s*\1", "\n\n", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"<!--.*?-->|\$\$.*?\$\$", "\n\n", text, flags=re.DOTALL)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", re.sub(r"`[^`]*`", "code", text))
    for block in re.split(r"\n\s*\n|\n(?=\s*(?:[-*+]|\d+\.|\||#|>|!!!|:::)\s?)|\|", text):
        yield from re.split(r"(?<=[.!?])[\"')*_]*\s+", " ".join(block.split()))


def check_docs() -> Iterator[str]:
    """Yield a line for each sentence of the docs that is too long."""
    for path in _files(DOCS, ".md"):
        for sentence in sentences(path.read_text("utf-8")):
            words = [w for w in sentence.split() if re.search(r"\w", w)]
            if len(words) > LONGEST_SENTENCE:
                yield f"{path}: {len(words)} words: {' '.join(words[:9])} ..."


if __name__ == "__main__":
    found = [*check_code(), *check_docs()]
    sys.stdout.write("\n".join(found or ["words: no finding"]) + "\n")
    sys.exit(bool(found))
