"""The socket that the server listens at."""

import socket

import pytest

pytest.importorskip("uvicorn", reason="extra: serve")

from placegraph_serve.app import listen


def test_answers_do_not_wait_for_the_client():
    with listen("127.0.0.1", 0) as listening, socket.create_connection(listening.getsockname()):
        taken, _ = listening.accept()
        with taken:
            assert taken.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
