"""Ctrl-C is seen wherever it falls."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from contextlib import suppress

import pytest

from placegraph.cli.common import INTERRUPTED, interruptible

DEAF = """
import signal, threading
from placegraph.cli import common as interrupts
interrupts.GRACE = 0.01
signal.signal(signal.SIGINT, lambda *_: None)
with interrupts.interruptible():
    print("begun", flush=True)
    threading.Event().wait()
"""


@pytest.fixture
def pressed():
    """Press Ctrl-C; whoever started the tests may have it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield lambda: signal.raise_signal(signal.SIGINT)
    signal.signal(signal.SIGINT, before)


def test_one_that_falls_where_exceptions_are_ignored_is_raised_again(pressed):
    class Falling:
        def __del__(self):
            pressed()

    hook = sys.unraisablehook

    def lose_one():
        with interruptible():
            Falling()  # dies at once, and Python ignores what a destructor raises
            threading.Event().wait(60.0)

    with pytest.raises(KeyboardInterrupt):
        lose_one()
    assert sys.unraisablehook is hook
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_other_ignored_exceptions_are_told_as_ever(capsys):
    class Failing:
        def __del__(self):
            raise ValueError("in a destructor")

    with interruptible():
        Failing()
    assert "ValueError: in a destructor" in capsys.readouterr().err


def test_nothing_of_it_in_other_threads():
    done = []

    def work():
        with interruptible():
            done.append(1)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done == [1]


def test_the_second_ends_what_does_not_end_itself():
    command = [sys.executable, "-c", DEAF]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:  # noqa: S603
        try:
            assert process.stdout.readline() == "begun\n"
            while process.poll() is None:
                process.send_signal(signal.SIGINT)  # until it is seen, and once more
                with suppress(subprocess.TimeoutExpired):
                    process.wait(1.0)
        finally:
            process.kill()
    assert process.returncode == INTERRUPTED
