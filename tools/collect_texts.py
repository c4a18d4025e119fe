"""Collect the texts that a person may see: messages, reasons, questions, help, the page.

usage: python tools/collect_texts.py [--write]    (in the repository's root; --write renews tests/texts.txt)
"""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

LIST = Path("tests/texts.txt")
SOURCES = ("src", *sorted(str(p) for p in Path("packages").glob("*/src")))
NO_TEXT = re.compile(
    r"^\s*(SELECT|INSERT|CREATE|UPDATE|DELETE|PRAGMA)\b|[\\^$]|^[-\w./]+( [-\w./]+)?$"
    r"|\b(FROM|WHERE|JOIN)\b|_msgs/|float64 |uint8 |[a-z_]+=\* |[a-z]>[a-z]\w* \w+>|(default|style)-src"
    r"|\|\| | && |Math\.|</|\(prefers-|^[\w.]+(, [\w.()]+){2,}$|system-ui"
)
PAGE_TEXT = re.compile(r"\"([^\"\n]*)\"|'([^'\n]*)'|`([^`]*)`|>([^<>{}\n]+)<")


def _is_text(text: str) -> bool:
    """Return whether a string is a phrase: two words with letters, and neither SQL nor a pattern."""
    return (
        len(re.findall(r"[^\W\d_]{2,}", text)) > 2
        and " " in text.strip()
        and not NO_TEXT.search(text)
    )


def _help(function: ast.FunctionDef) -> str:
    """Return the help of a command, whose docstring gives an example of its use; else nothing."""
    text = ast.get_docstring(function) or ""
    return text if re.search(r"Examples?: placegraph", text) else ""


def _python(path: Path) -> Iterator[str]:
    tree = ast.parse(path.read_text("utf-8"))
    skipped: set[ast.AST] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and (help_text := _help(node)):
            yield from help_text.split("\n\n")
        if isinstance(node, ast.Expr):
            skipped.add(node.value)  # a docstring
        if node in skipped:
            continue
        if isinstance(node, ast.JoinedStr):
            skipped |= set(ast.walk(node))
            yield "".join(
                str(v.value) if isinstance(v, ast.Constant) else "{}" for v in node.values
            )
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def _page(path: Path) -> Iterator[str]:
    text = re.sub(r"^\s*(//|\*|/\*).*$", "", path.read_text("utf-8"), flags=re.MULTILINE)
    for groups in PAGE_TEXT.findall(text):
        yield re.sub(r"\$\{[^}]*\}", "{}", next((g for g in groups if g), ""))


def collect() -> Iterator[str]:
    """Yield a line for each file and each of its texts, in the order of the sources."""
    for source in SOURCES:
        for path in sorted(p for s in ("py", "js", "html") for p in Path(source).rglob(f"*.{s}")):
            texts = _python(path) if path.suffix == ".py" else _page(path)
            lines = [" ".join(t.split()) for t in texts if _is_text(t)]
            if lines:
                yield f"# {path.as_posix()}"
                yield from sorted(set(lines))


if __name__ == "__main__":
    text = "\n".join(collect()) + "\n"
    if "--write" in sys.argv:
        LIST.write_text(text, "utf-8")
    else:
        sys.stdout.write(text)
