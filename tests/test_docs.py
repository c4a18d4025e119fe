"""Every code block in README.md and docs/**/*.md runs, or says why it does not.

A page is one test. Its blocks run in order, in one folder and one Python namespace, with the files
of the demo's world and the maps made of them lying there. A ``python`` block is executed. Of a
``bash`` block every line, of a ``console`` block every line behind ``$``, must be a ``placegraph``
command; a trailing ``# exits with 6`` says what is expected instead of 0. ``../shared`` stands for
the folder of shared data, where it exists. A block with ``<!-- no-run: reason -->`` on the line
above is skipped, with its reason. `make test` leaves out the pages of `LONG`, `make test-all` none.
"""

import contextlib
import io
import os
import pkgutil
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path

import pytest

import placegraph as pg
from placegraph import cli
from placegraph.core import plugins
from placegraph.indoor.map.textures import DETAILS
from placegraph.indoor.mapping.change.changes import DiffOptions
from placegraph.indoor.mapping.fuse import FuseOptions
from placegraph.indoor.mapping.segment import SegmentOptions

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
LONG = {"encoders", *(f"howto-{subject}" for subject in (
    "anchor", "bags", "follow", "hydra", "library", "maps", "planet", "refine", "ros", "serve",
))}  # fmt: skip
"""Pages of many seconds, whose subjects have tests of their own on every run."""
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


def run_shell(block, monkeypatch):
    for line, expected in commands(block):
        code, said = call(shlex.split(real(line)), monkeypatch)
        assert code == expected, f"{block}: {line!r} exits with {code}, not {expected}:\n{said}"


def call(words, monkeypatch):
    """Exit code and output of a command with ``< file`` and ``> file``, run in this process."""
    streams = {"<": None, ">": None}
    while len(words) > 2 and words[-2] in streams:
        *words, arrow, name = words
        streams[arrow] = name
    stdin = Path(streams["<"]).read_text("utf-8") if streams["<"] else ""
    monkeypatch.setattr(sys, "argv", words)
    monkeypatch.setattr(sys, "stdin", io.StringIO(stdin))
    out, err, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cli.main()
        except SystemExit as end:
            code = end.code or 0
    if streams[">"]:
        Path(streams[">"]).write_text(out.getvalue(), "utf-8")
    return code, out.getvalue() + err.getvalue()


def run(block, namespace, monkeypatch):
    if block.language in SHELL:
        run_shell(block, monkeypatch)
    else:
        source = "\n" * block.line + real(block.body)  # tracebacks name the page's own lines
        exec(compile(source, str(block.page), "exec"), namespace)  # noqa: S102


@pytest.mark.parametrize(
    "page",
    [pytest.param(p, marks=pytest.mark.all if p.stem in LONG else (), id=str(p.relative_to(ROOT)))
     for p in PAGES],
)  # fmt: skip
def test_page(page, request, tmp_path, monkeypatch):
    blocks = blocks_of(page, page.read_text("utf-8"))
    assert all(block.reason != "" for block in blocks), f"{page}: a no-run without a reason"
    wanted = [block for block in blocks if block.reason is None]
    if not wanted:
        return
    folder = tmp_path / "world"
    shutil.copytree(request.getfixturevalue("demo_world"), folder)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("COLUMNS", "100")
    namespace = {"__name__": "docs"}
    for block in wanted:
        if block.needs_shared and not SHARED.is_dir():
            pytest.skip(f"{block} needs ../shared")
        run(block, namespace, monkeypatch)


PATH = re.compile(r"`((?:src|packages|lab|tests|docs|examples)/[\w./-]+)")
NAME = re.compile(r"`((?:placegraph(?:_lab|_io|_ros|_scale|_serve|_learn)?)(?:\.\w+)+)")


def exists(name):
    """Whether a dotted name is that of a module, of something in one, or of a group of entry points."""
    if name in vars(plugins).values():
        return True
    with contextlib.suppress(ImportError, AttributeError):
        pkgutil.resolve_name(name)
        return True
    return False


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_files_and_names_that_are_spoken_of_exist(page):
    text = page.read_text("utf-8")
    missing = [path for path in PATH.findall(text) if not (ROOT / path.rstrip(".")).exists()]
    missing += [name for name in NAME.findall(text) if not exists(name)]
    assert not missing


def test_the_reference_has_every_public_name():
    listed = re.findall(
        r"^::: placegraph\.(\w+)$", (ROOT / "docs/reference.md").read_text(), re.MULTILINE
    )
    assert set(pg.__all__) - {"__version__"} <= set(listed)


def folders(top, depth):
    """Packages below a folder, not those that hold data alone."""
    if not depth:
        return set()
    own = {p.parent for p in top.glob("*/*.py")}
    return own.union(*(folders(folder, depth - 1) for folder in own))


def test_the_architecture_lists_the_rooms_that_there_are():
    tree = (ROOT / "docs/architecture.md").read_text("utf-8").split("```")[1]
    listed, above = set(), {}
    for line in tree.splitlines():
        indent, name = re.match(r"( *)(\S*)", line).groups()
        if name.endswith("/"):
            above[len(indent)] = above.get(len(indent) - 2, ROOT) / name
            listed.add(above[len(indent)])
    src, lab = ROOT / "src/placegraph", ROOT / "lab/src/placegraph_lab"
    there = folders(src, 1) | folders(src / "outdoor", 1) | folders(src / "indoor", 1)
    there |= folders(src / "io", 1) | folders(lab, 1) | {src, lab}
    there |= {p.parent for p in (ROOT / "packages").glob("*/pyproject.toml")} - {ROOT / "packages"}
    assert there == listed - {ROOT / "packages", ROOT / "examples"}


def test_the_numbers_on_the_pages_of_scene_maps_are_the_defaults():
    fuse, cut, compare = FuseOptions(), SegmentOptions(), DiffOptions()
    assert (fuse.least, fuse.speck, fuse.memory) == (0.0003, 0.02, 1.5)
    assert (cut.flatness, cut.wall_area, cut.wall_height, cut.mark) == (0.05, 1.5, 1.2, 0.05)
    assert (cut.carpet, cut.crease, cut.contrast, cut.gap) == (0.5, 0.6, 25.0, 0.03)
    assert (cut.support, cut.thin, cut.least) == (0.12, 0.5, 0.02)
    assert (compare.frames, compare.reach, compare.least_pixels) == (60, 4.0, 100)
    assert (compare.least_frames, compare.depth_floor, compare.depth_slope) == (3, 0.04, 0.015)
    text = (ROOT / "docs/howto-maps.md").read_text("utf-8")
    for name, detail in DETAILS.items():
        (row,) = re.findall(rf"^\| `{name}` \|.*", text, re.MULTILINE)
        lengths = [
            float(n) * {"m": 0.001, "c": 0.01}[u] for n, u in re.findall(r"(\d+) ([mc])m", row)
        ]
        expected = [x for x in (detail.error, detail.texel, detail.baked) if x]
        assert lengths == pytest.approx(expected), name


@pytest.mark.all
def test_the_site_is_built_and_its_links_lead_somewhere(tmp_path):
    pytest.importorskip("mkdocs")
    result = subprocess.run(  # noqa: S603  # our own interpreter and site
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert "placegraph city locate" in (tmp_path / "commands.html").read_text("utf-8")


def test_a_shell_block_that_would_not_run_or_exits_otherwise_fails(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for body in ("make demo", "", "# placegraph", "placegraphs x"):
        (block,) = blocks_of(Path("page.md"), f"```bash\n{body}\n```\n")
        with pytest.raises(pytest.fail.Exception, match=r"page\.md:1: .*no-run: reason"):
            commands(block)
    text = "```bash\nplacegraph city info gone.city  # exits with 5\n```\n"
    with pytest.raises(AssertionError, match="exits with 3, not 5"):
        run_shell(*blocks_of(Path("page.md"), text), monkeypatch)
