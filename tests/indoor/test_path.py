"""Modules that a window of frames passes, counted by a profile: a newcomer has to read no more."""

import sys
from pathlib import Path

import placegraph
from placegraph.core.estimate import Status

ROOT = Path(placegraph.__file__).parent
MOST = 37


def modules_of(work):
    """Files of the package whose functions are entered while `work` runs, but for its packages' faces."""
    entered = set()

    def note(frame, event, _):
        if event == "call":
            entered.add(frame.f_code.co_filename)

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        result = work()
    finally:
        sys.setprofile(before)
    inside = {Path(name).relative_to(ROOT) for name in entered if name.startswith(f"{ROOT}/")}
    return result, sorted(str(path) for path in inside)


def test_a_window_passes_few_modules(room, walk):
    room.localize(walk)
    estimate, modules = modules_of(lambda: room.localize(walk))
    assert estimate.status is Status.OK
    assert len(modules) <= MOST, "\n".join(modules)
