import importlib.util
import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tests.vectors.conftest import *  # noqa: F403  # fixtures
from tests.vectors.conftest import make_cloud

from placegraph.errors import ServiceError
from placegraph.vectors import Vectors
from placegraph_scale.milvus import Server


class FakeMilvus:
    """Milvus in memory, as far as placegraph asks it; `plan` makes it fail.

    `plan` maps a method to what happens at its calls, first to last: None goes well, "dead" raises
    and leaves the server dead, "refused" raises, "lost answer" does it and raises, "half" does half
    of it and dies, "doubled" does it twice, "forgotten" answers well and does nothing.
    """

    def __init__(self):
        self.held, self.plan, self.calls, self.dead = {}, {}, [], False

    @staticmethod
    def create_schema(**options):
        from pymilvus import MilvusClient

        return MilvusClient.create_schema(**options)

    @staticmethod
    def prepare_index_params():
        from pymilvus import MilvusClient

        return MilvusClient.prepare_index_params()

    def __getattr__(self, method):
        work = getattr(type(self), f"do_{method}")
        return lambda *arguments, **options: self._call(method, work, *arguments, **options)

    def _call(self, method, work, *arguments, timeout=None, **options):
        from pymilvus.exceptions import MilvusException

        assert timeout is None or 0 < timeout <= 600
        assert timeout or method == "close"
        self.calls.append(method)
        plan = self.plan.get(method, [])
        fate = plan.pop(0) if plan and not self.dead else None
        self.dead = self.dead or fate in ("dead", "half")
        if fate == "half":
            work(self, arguments[0], arguments[1][: len(arguments[1]) // 2], **options)
        if self.dead or fate == "refused":
            logging.getLogger("pymilvus.decorators").error("as pymilvus does before it raises")
            raise MilvusException(code=2, message=f"server\n unavailable for {method}")
        if fate == "forgotten":
            return None
        answer = work(self, *arguments, **options)
        if fate == "doubled":
            work(self, *arguments, **options)
        if fate == "lost answer":
            raise MilvusException(code=1, message="deadline exceeded")
        return answer

    def do_list_collections(self):
        return list(self.held)

    def do_describe_collection(self, name):
        held = self.held[name]
        fields = [{"name": "id", "params": {}}, {"name": "vector", "params": {"dim": held["dim"]}}]
        return {"description": held["description"], "fields": fields}

    def do_create_collection(self, name, schema):
        fields = {f.name: f for f in schema.fields}
        assert set(fields) == {"id", "vector", "longitude", "latitude"}
        assert fields["id"].is_primary
        self.held[name] = {
            "description": schema.description,
            "dim": fields["vector"].params["dim"],
            "rows": [],
            "index": None,
            "loaded": False,
        }

    def do_insert(self, name, rows):
        self.held[name]["rows"] += rows

    def do_upsert(self, name, rows):
        gone = {row["id"] for row in rows}
        kept = [row for row in self.held[name]["rows"] if row["id"] not in gone]
        self.held[name]["rows"] = kept + rows

    def do_flush(self, name):
        assert name in self.held

    def do_create_index(self, name, index):
        (self.held[name]["index"],) = [i.to_dict()["index_type"] for i in index]

    def do_load_collection(self, name):
        assert self.held[name]["index"]
        self.held[name]["loaded"] = True

    def _rows(self, name, condition):
        assert self.held[name]["loaded"], "a collection is loaded before it is read"
        rows = self.held[name]["rows"]
        return [r for r in rows if not condition or eval(condition, {}, r)]  # noqa: S307

    def do_query(self, name, filter, output_fields, consistency_level):  # noqa: A002
        assert (output_fields, consistency_level) == (["count(*)"], "Strong")
        return [{"count(*)": len(self._rows(name, filter))}]

    def do_search(self, name, data, limit, filter, search_params, consistency_level):  # noqa: A002
        assert not name.endswith("_loading"), "half a store is never searched"
        (self.effort,) = search_params.values()
        assert consistency_level == "Bounded"
        rows = self._rows(name, filter)
        answers = []
        for query in data:
            hits = [{"id": r["id"], "distance": float(r["vector"] @ query)} for r in rows]
            answers.append(sorted(hits, key=lambda h: -h["distance"])[:limit])
        return answers

    def do_rename_collection(self, name, new):
        assert new not in self.held
        self.held[new] = self.held.pop(name)

    def do_drop_collection(self, name):
        del self.held[name]

    def do_close(self):
        self.held = self.held


@pytest.fixture
def fake():
    pytest.importorskip("pymilvus", reason="needs the extra milvus")
    return FakeMilvus()


@pytest.fixture
def server(fake, monkeypatch):
    monkeypatch.setattr("placegraph_scale.milvus.sleep", lambda _: None)
    return Server(fake, "http://root:secret@fake:19530")


@pytest.fixture
def content(rng):
    return Vectors.of(*make_cloud(rng, 47))


class RealMilvus:
    def __init__(self, folder: Path):
        self.folder = folder
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.uri = f"http://127.0.0.1:{self.port}"
        self.process = None

    def start(self):
        command = [sys.executable, "-c", "import milvus; milvus.main()"]
        command += ["--data", str(self.folder), "--proxy-port", str(self.port)]
        log = self.folder / "server.log"
        with log.open("a") as output:
            self.process = subprocess.Popen(  # noqa: S603 -- this interpreter
                command, cwd=self.folder, start_new_session=True, stdout=output, stderr=output,
            )  # fmt: skip
        last = time.monotonic() + 90.0
        while time.monotonic() < last:
            if self.process.poll() is not None:
                pytest.skip(
                    f"needs a Milvus server, which ends at once here: {log.read_text()[-300:]}"
                )
            try:
                server = Server.connect(self.uri, 5.0)
                server.collections()
            except ServiceError:
                time.sleep(0.3)
            else:
                server.close()
                return
        self.kill()
        pytest.fail(f"Milvus does not answer: {log.read_text()[-1000:]}")

    def kill(self):
        if self.process is not None:
            os.killpg(self.process.pid, signal.SIGKILL)  # its whole group: the server is a child
            self.process.wait()
            self.process = None


@pytest.fixture(scope="session")
def milvus(tmp_path_factory):
    pytest.importorskip("pymilvus", reason="needs the extra milvus")
    if importlib.util.find_spec("milvus") is None:
        pytest.skip("needs the package milvus, which has the server (Linux on x86_64)")
    running = RealMilvus(tmp_path_factory.mktemp("milvus"))
    try:
        running.start()
        yield running
    finally:
        running.kill()
        shutil.rmtree(running.folder, ignore_errors=True)  # the unpacked server is large
