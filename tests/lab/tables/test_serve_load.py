import http.server
import os
import shutil
import threading
from types import SimpleNamespace

import pytest

from placegraph_lab.tables.named.serve_load import Request, Served


@pytest.fixture
def asked():
    """A server in a thread, and all that it was asked."""
    seen = []

    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_POST(self):
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            seen.append((self.command, self.path, self.headers.get("Content-Type"), body))
            self.send_response(404 if self.path == "/none" else 200)
            self.send_header("Content-Length", "0")
            self.end_headers()

        do_GET = do_POST  # noqa: N815

        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    process = SimpleNamespace(pid=os.getpid())
    yield Served(process, f"http://127.0.0.1:{server.server_port}"), seen
    server.shutdown()
    thread.join()
    server.server_close()


def test_requests_are_asked_in_turn(asked, tmp_path):
    if shutil.which("wrk") is None:
        pytest.skip("wrk is not installed")
    server, seen = asked
    picture = Request(
        "POST", "/none", b"\x00\n\xff GET /x y 3\n", "multipart/form-data; boundary=a"
    )
    requests = [Request.of("/say", text="Bäckerei\n"), picture, Request("GET", "/healthz")]
    told = server.send(requests, tmp_path / "asked", at_once=1, seconds=1)
    kinds = [("POST", "/say", "application/json", requests[0].body),
             ("POST", "/none", picture.kind, picture.body),
             ("GET", "/healthz", "application/json", b"")]  # fmt: skip
    # wrk takes the first to look at it
    assert seen == [kinds[(i + 1) % 3] for i in range(len(seen))]
    assert abs(told["requests"] - len(seen)) <= 2  # one was on its way
    assert abs(told["failed"] - len(seen) / 3) <= 2
    assert 0 < told["p50_ms"] <= told["p95_ms"]
    assert told["cpu_ms"] >= 0
    assert server.memory() > 1
