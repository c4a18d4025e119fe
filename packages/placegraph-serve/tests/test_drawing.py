"""What is drawn is made once, and kept while there is room."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

pytest.importorskip("fastapi", reason="extra: serve")

from placegraph_serve.drawing import Kept


def test_what_two_ask_for_at_once_is_made_once():
    kept, made = Kept(100), []
    begun, go = threading.Event(), threading.Event()

    def make():
        made.append(1)
        begun.set()
        assert go.wait(60)
        return b"drawn"

    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(kept.get, ("a",), make)
        assert begun.wait(60)
        second = pool.submit(kept.get, ("a",), make)
        go.set()
        assert first.result() == second.result() == b"drawn"
    assert made == [1]


def test_what_was_asked_for_longest_ago_goes_first():
    kept, made = Kept(5), []

    def ask(key):
        return kept.get((key,), lambda: made.append(key) or key.encode() * 2)

    assert [ask(key) for key in "abaca"] == [b"aa", b"bb", b"aa", b"cc", b"aa"]
    assert made == ["a", "b", "c"]
    assert (ask("b"), made[-1], kept.size) == (b"bb", "b", 4)
