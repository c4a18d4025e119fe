"""Check how code is worded: openings of docstrings, names.

usage: python tools/check_words.py    (in the repository's root; exit code 1 where something is found)
"""

import ast
import re
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

CODE = ("src", "packages", "lab/src", "examples")
ODD_OPENINGS = frozenset({"What", "Where", "How", "Who", "Whatever", "Of", "As", "Such"})
ODD_SHARE = 0.005  # of all docstrings, those of attributes included
# Bare participles, pronouns and metaphors; docs/glossary.md has the terms that stand instead.
OLD_NAMES = frozenset(Path(__file__).with_name("old_names.txt").read_text("utf-8").split())
PARTICIPLE = re.compile(
    "[a-z]*(ed|wn|en|elt|ost|ung|aid|ept|ought|aught|eant|orn)|(un)?bound|built|done|found|gone|heard|held"
    "|led|left|lent|made|met|seen|sent|sold|spent|stood|struck|told"
    "|all|another|any|both|each|it|many|mine|most|none|one|others|ours|own|same|some|that|them|there|these|they"
    "|this|those|which|whole"
)
_REASONS = Path(__file__).with_name("name_exceptions.txt").read_text("utf-8")
EXCEPTIONS = frozenset(re.findall(r"^\w+", _REASONS, re.MULTILINE))  # names that stay


def _names(node: ast.AST) -> Iterator[str]:
    """Yield the names that a class or function defines: its own, its parameters, its fields."""
    if isinstance(node, ast.ClassDef):
        fields = (f.target for f in node.body if isinstance(f, ast.AnnAssign))
        yield from (node.name, *(f.id for f in fields if isinstance(f, ast.Name)))
    elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        args = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
        yield from (node.name, *(a.arg for a in args))


def _docstrings(node: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and text of the docstrings of a module, class or function, and of its attributes."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module):
        yield getattr(node, "lineno", 1), ast.get_docstring(node) or ""
        for before, text in pairwise(node.body):
            if isinstance(before, ast.Assign | ast.AnnAssign) and isinstance(text, ast.Expr):
                value = getattr(text.value, "value", "")
                yield text.lineno, value if isinstance(value, str) else ""


def participles(node: ast.Module | ast.ClassDef) -> Iterator[tuple[int, str]]:
    """Yield line and name of public classes, functions and methods that are a participle or pronoun."""
    for child in node.body:
        if isinstance(child, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            is_property = any("property" in ast.unparse(d) for d in child.decorator_list)
            if PARTICIPLE.fullmatch(child.name[0].lower() + child.name[1:]) and not is_property:
                yield child.lineno, child.name
        if isinstance(child, ast.ClassDef):
            yield from participles(child)


def modules() -> Iterator[tuple[Path, ast.Module]]:
    """Yield path and syntax tree of each module that is no test."""
    for root in CODE:
        for path in sorted(Path(root).rglob("*.py")):
            if "tests" not in path.parts:
                yield path, ast.parse(path.read_text("utf-8"))


def check_names() -> Iterator[str]:
    """Yield a line for each old or bare name."""
    for path, tree in modules():
        if path.stem in OLD_NAMES:
            yield f"{path}:1: {path.stem}: old name of a module; docs/glossary.md has the field's"
        for line, name in participles(tree):
            if name not in EXCEPTIONS:
                yield f"{path}:{line}: {name}: bare participle or pronoun; say verb and object, or a noun"
        for node in ast.walk(tree):
            for name in _names(node):
                if name.strip("_").lower() in OLD_NAMES and name not in EXCEPTIONS:
                    line = getattr(node, "lineno", 1)
                    yield f"{path}:{line}: {name}: old name; docs/glossary.md has the field's"


def check_openings() -> Iterator[str]:
    """Yield a line for each docstring with an odd opening, if they are too many."""
    docstrings = [
        (p, *d) for p, tree in modules() for node in ast.walk(tree) for d in _docstrings(node)
    ]
    odd = [
        f"{path}:{line}: docstring opens with {text.split()[0]}: use a verb or a noun"
        for path, line, text in docstrings
        if (text.split(maxsplit=1) or [""])[0].strip(".,:`\"'") in ODD_OPENINGS
    ]
    if len(odd) > ODD_SHARE * len(docstrings):
        yield from odd


if __name__ == "__main__":
    found = [*check_names(), *check_openings()]
    sys.stdout.write("\n".join(found or ["words: no finding"]) + "\n")
    sys.exit(bool(found))
