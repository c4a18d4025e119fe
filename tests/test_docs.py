"""Every code block in README.md and docs/*.md runs, or says why it does not.

Blocks of a page run in order, in one folder and one Python namespace, with the files of `helpers`
lying there. A ``python`` block is executed. Of a ``bash`` block every line, of a ``console`` block
every line behind ``$``, must be a ``placegraph`` command; a trailing ``# exits with 6`` says what
is expected instead of 0. ``../shared`` stands for the folder of shared data, where it exists.
A block with ``<!-- no-run: reason -->`` on the line above is skipped, with its reason.
"""

import os
import re
import subprocess
import sys
import textwrap
from dataclasses import dataclass, field
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SHELL = ("bash", "sh", "shell", "console")

FENCE = re.compile(
    r"^(?:[ ]*<!--\s*no-run:(?P<reason>.*?)-->\n+)?"
    r"(?P<indent>[ ]*)```(?P<language>python|bash|sh|shell|console)[^\n]*\n"
    r"(?P<body>.*?)^(?P=indent)```[ ]*$",
    re.MULTILINE | re.DOTALL,
)
EXIT = re.compile(r"#\s*exits with (\d+)\s*$")


@dataclass
class Block:
    page: Path
    line: int
    language: str
    body: str
    reason: str | None

    @property
    def needs_shared(self):
        return "../shared" in self.body

    def __str__(self):
        return f"{self.page.name}:{self.line}"


@dataclass
class Page:
    """What the blocks of a page share."""

    folder: Path
    namespace: dict = field(default_factory=lambda: {"__name__": "docs"})
    done: set = field(default_factory=set)
    stopped: str = ""


def blocks_of(page, text):
    found = []
    for match in FENCE.finditer(text):
        line = text.count("\n", 0, match.start("language")) + 1
        reason = match["reason"]
        body = textwrap.dedent(match["body"])
        found.append(Block(page, line, match["language"], body, reason and reason.strip()))
    return found


def commands(block):
    """Placegraph commands of a shell block with the exit codes expected of them."""
    lines = block.body.replace("\\\n", " ").splitlines()
    if block.language == "console":
        lines = [line.removeprefix("$").strip() for line in lines if line.startswith("$")]
    lines = [line.strip() for line in lines if line.strip() and not line.strip().startswith("#")]
    foreign = [line for line in lines if not re.match(r"placegraph\b", line)]
    if foreign or not lines:
        pytest.fail(
            f"{block}: {(foreign or ['nothing'])[0]!r} is not a placegraph command; "
            "write <!-- no-run: reason --> on the line above the block."
        )
    codes = [EXIT.search(line) for line in lines]
    return [
        (EXIT.sub("", line).strip(), int(code[1]) if code else 0)
        for line, code in zip(lines, codes, strict=True)
    ]


def real(text):
    return text.replace("../shared", str(SHARED))


def run_shell(block, folder):
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    for line, expected in commands(block):
        result = subprocess.run(  # noqa: S603  # what our own pages say
            ["/bin/bash", "-eu", "-o", "pipefail", "-c", real(line)],
            cwd=folder,
            env=os.environ | {"PATH": path, "COLUMNS": "100"},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert result.returncode == expected, (
            f"{block}: {line!r} exits with {result.returncode}, not {expected}:\n"
            f"{result.stdout}{result.stderr}"
        )


def run(block, page, monkeypatch):
    if block.language in SHELL:
        run_shell(block, page.folder)
    else:
        monkeypatch.chdir(page.folder)
        source = "\n" * block.line + real(block.body)  # tracebacks name the page's own lines
        exec(compile(source, str(block.page), "exec"), page.namespace)  # noqa: S102


def helpers(folder):
    """Files a page may take for granted: the town of the demo."""
    from placegraph_lab.worlds.town.town import Town

    Town.load("hafenstadt").write_osm(folder / "hafenstadt.osm")


BLOCKS = [block for page in PAGES for block in blocks_of(page, page.read_text("utf-8"))]


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    found = {page: Page(tmp_path_factory.mktemp(page.stem)) for page in PAGES}
    for page in found.values():
        helpers(page.folder)
    return found


@pytest.mark.parametrize("block", BLOCKS, ids=str)
def test_block(block, pages, monkeypatch):
    if block.reason is not None:
        assert block.reason, f"{block}: no-run needs a reason"
        pytest.skip(f"no-run: {block.reason}")
    page = pages[block.page]
    # Those above come first, also where this one was asked for alone.
    above = BLOCKS[: BLOCKS.index(block) + 1]
    for earlier in above:
        if earlier.page != block.page or earlier.reason is not None or earlier.line in page.done:
            continue
        if page.stopped:
            pytest.skip(page.stopped)
        if earlier.needs_shared and not SHARED.is_dir():
            page.stopped = f"{earlier} needs ../shared"
            pytest.skip(page.stopped)
        page.done.add(earlier.line)
        run(earlier, page, monkeypatch)


# --- the runner itself ---


def example(text):
    return blocks_of(Path("page.md"), textwrap.dedent(text))


def test_blocks_are_found_with_line_language_and_reason():
    found = example(
        """\
        Words.

        ```python
        a = 1
        ```
        <!-- no-run: draws on the network -->
        ```bash
        placegraph city fetch "Ulm"
        ```
        - item
          ```console
          $ placegraph --version
          placegraph 0.1.0
          ```
        ```json
        {}
        ```
        """
    )
    assert [(b.line, b.language, b.reason) for b in found] == [
        (3, "python", None),
        (7, "bash", "draws on the network"),
        (11, "console", None),
    ]
    assert found[0].body == "a = 1\n"
    assert commands(found[2]) == [("placegraph --version", 0)]


def test_commands_are_read_with_continuations_comments_and_exit_codes():
    (block,) = example(
        """\
        ```bash
        # build it first
        placegraph city build a.osm \\
          -o a.city
        placegraph city info gone.city  # exits with 3
        ```
        """
    )
    build, info = commands(block)
    assert build[0].split() == ["placegraph", "city", "build", "a.osm", "-o", "a.city"]
    assert info == ("placegraph city info gone.city", 3)


@pytest.mark.parametrize("body", ["make demo", "", "# placegraph", "placegraphs x"])
def test_a_shell_block_that_would_not_run_must_say_so(body):
    (block,) = example(f"```bash\n{body}\n```\n")
    with pytest.raises(pytest.fail.Exception, match=r"page\.md:1: .*no-run: reason"):
        commands(block)


def test_a_wrong_block_fails_where_it_stands(tmp_path, monkeypatch):
    (block,) = example("```python\n\n1 / 0\n```\n")
    with pytest.raises(ZeroDivisionError) as caught:
        run(block, Page(tmp_path), monkeypatch)
    assert caught.traceback[-1].lineno + 1 == 3


def test_a_wrong_exit_code_fails(tmp_path):
    (block,) = example("```bash\nplacegraph() { return 6; }; placegraph  # exits with 5\n```\n")
    with pytest.raises(AssertionError, match="exits with 6, not 5"):
        run_shell(block, tmp_path)
