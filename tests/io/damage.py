"""Damage to files, and the property of every reader: an answer, or a typed error that names the file."""

from contextlib import contextmanager, suppress

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from placegraph.errors import InputError, PlacegraphError
from placegraph.io.capture.capture import open_capture

DAMAGE = settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
TOKENS = (b"nan", b"1e999", b"-", b"[", b"null", b",", b"9" * 400)


@st.composite
def damaged(draw, content, within=None):
    """Bytes of a file, some of which are replaced, or which holds nonsense, or ends early."""
    bad = bytearray(content)
    last = min(len(bad), within or len(bad)) - 1
    for _ in range(draw(st.integers(0, 4))):
        bad[draw(st.integers(0, last))] = draw(st.integers(0, 255))
    if draw(st.booleans()):
        at = draw(st.integers(0, last))
        bad[at:at] = draw(st.sampled_from(TOKENS))
    return bytes(bad[: draw(st.integers(0, last))] if draw(st.booleans()) else bad)


@contextmanager
def refusing(name=""):
    """Accept an `InputError` that names the file."""
    try:
        yield
    except InputError as error:
        assert str(name) in str(error)  # noqa: PT017  # either is right


def read_damaged(folder, data, write):
    """Write a capture once, damage one of its files but for videos, and read its last frame."""
    if not any(folder.iterdir()):
        write(folder)
    files = [p for p in sorted(folder.iterdir()) if p.suffix not in {".mp4", ".mov", ".m4v"}]
    file = data.draw(st.sampled_from([p for p in files if p.is_file()]))
    good = file.read_bytes()
    file.write_bytes(data.draw(damaged(good)))
    with suppress(PlacegraphError):
        frame = open_capture(folder)[-1]
        frame.rgb(), frame.depth()
    file.write_bytes(good)


def any_json(*keys):
    """JSON values, the objects of which have these keys."""
    names = st.sampled_from(keys) if keys else st.text(max_size=3)
    return st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(names, inner, max_size=4),
        max_leaves=12,
    )
