"""Ranges shared among threads: every row once, from as many threads at once as one likes."""

import os
import threading

import numpy as np
import pytest

from placegraph.core.jit import kernel
from placegraph.core.threads import limited, processors, share
from placegraph.errors import OptionError


@kernel
def _count(amount, out, first, last):
    for row in range(first, last):
        out[row] += amount


@pytest.mark.parametrize("most", [None, 1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 2, 7, 1000])
def test_every_row_once(count, most):
    out = np.zeros(count, np.int64)
    if most is None:
        share(_count, count, 3, out)
    else:
        with limited(most):
            share(_count, count, 3, out)
    assert (out == 3).all()


def test_many_ask_at_once():
    outs = [np.zeros(5000, np.int64) for _ in range(6)]
    asked = [
        threading.Thread(target=share, args=(_count, 5000, i, out)) for i, out in enumerate(outs)
    ]
    for thread in asked:
        thread.start()
    for thread in asked:
        thread.join()
    assert all((out == i).all() for i, out in enumerate(outs))


def _sees_every_row():
    out = np.zeros(1000, np.int64)
    share(_count, 1000, 3, out)
    return (out == 3).all()


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.skipif(processors() < 2, reason="one processor has no helpers")
def test_helpers_are_kept_and_a_fork_has_its_own():
    def helpers():
        return {t.ident for t in threading.enumerate() if t.name.startswith("placegraph")}

    assert _sees_every_row()
    before = helpers()
    assert 0 < len(before) < processors()
    assert _sees_every_row()
    assert before <= helpers()
    child = os.fork()
    if not child:
        os._exit(0 if _sees_every_row() else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_one_thread_is_the_caller():
    seen = []
    with limited(1):
        share(lambda first, last: seen.append((threading.get_ident(), first, last)), 100)
    assert seen == [(threading.get_ident(), 0, 100)]
    with pytest.raises(OptionError, match="at least 1"), limited(0):
        pass


def test_what_a_part_raises_is_raised():
    def fail(first, last):
        raise ValueError(f"{first} to {last}")

    with pytest.raises(ValueError, match="to"):
        share(fail, 100)
    assert processors() >= 1
