"""How much does a server bear? Sentences and images a second, idle WebSockets, memory.

A server of Vancouver and of the demo's flat runs beside wrk, which asks it over the loopback: what is
measured is both together. Sentences are drawn from the map, each another one.

    placegraph-lab table serve_load --quick

Prints a Markdown table and writes the rows as JSON. Needs wrk, and Linux for CPU and memory.
"""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

from placegraph.demo.world import FLAT, unpack
from placegraph.indoor.build import build_scene
from placegraph.io.capture.capture import open_capture
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, open_city
from placegraph_lab.tables.outdoor.queries import make_queries
from placegraph_lab.tables.runner import Quick, Run, Seed, markdown, number, option, table
from placegraph_lab.tables.serve.load import Request, Served, idle, served

CITY = "vancouver"
EDGE = "----placegraph"
HEADER = ["asked", "at once", "a second", "p50 ms", "p95 ms", "CPU ms each", "failed"]


@table()
def serve_load(
    run: Run,
    seed: Seed = 0,
    requests: Annotated[int, option("Cheap requests over which memory is watched.")] = 100_000,
    seconds: Annotated[int, option("Of each load.")] = 20,
    *,
    quick: Quick = False,
) -> None:
    """Sentences and images a second that a server answers, idle WebSockets, and its memory."""
    if quick:
        requests, seconds = 1_000, 4
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        world = unpack(folder / "raw")
        (folder / "maps").mkdir()
        open_city(CITY, run.osm, run.cache / "maps")
        shutil.copy(run.cache / "maps" / f"{CITY}.city", folder / "maps")
        build_scene(world / f"{FLAT}.glb", folder / "maps" / f"{FLAT}.scene")
        texts = sentences(run.osm / EXTRACTS[CITY], seed)
        with served(folder / "maps") as server:
            rows = list(loads(server, folder / "asked", texts, world / "walk", seconds))
            print(markdown(HEADER, map(line, rows)))
            sockets = asyncio.run(idle(server, 1000, {"id": 1, "text": texts[0], "map": CITY}))
            memory = watched(server, folder / "asked", texts, requests, seconds)
    print(f"\n{told(sockets, memory)}")
    run.save({"rows": rows, "sockets": sockets, "memory": memory, "busy": os.getloadavg()})


def sentences(extract: Path, seed: int) -> list[str]:
    """Some hundred texts of one to three sentences about the speaker."""
    drawn = (
        make_queries(extract, statements=count, setting="speaker", n=300, seed=seed)
        for count in (1, 2, 3)
    )
    return [query.text for trio in zip(*drawn, strict=True) for query in trio]


def loads(
    server: Served, file: Path, texts: list[str], walk: Path, seconds: int
) -> Iterator[dict[str, Any]]:
    """Sentences and pictures, few and many at once; the first seconds warm up and do not count."""
    asked = [Request.of("/v1/locate", text=text, map=CITY) for text in texts]
    server.asked(asked, file, at_once=4, seconds=2)
    for at_once in (1, 4, 8):
        yield {"asked": "sentences"} | server.asked(asked, file, at_once=at_once, seconds=seconds)
    files, gravity = sorted((walk / "rgb").iterdir()), open_capture(walk).gravity.tolist()
    plain = [picture(path) for path in files]
    leveled = [picture(path, [down]) for path, down in zip(files, gravity, strict=True)]
    server.asked(plain, file, at_once=1, seconds=2)
    for name, images in (("pictures", plain), ("pictures and gravity", leveled)):
        yield {"asked": name} | server.asked(images, file, at_once=2, seconds=seconds)


def picture(path: Path, gravity: list[list[float]] | None = None) -> Request:
    """A localization by one picture and its camera; where nobody tells gravity, tilts are tried."""
    camera = {"fx": 230.0, "width": 320, "height": 180}
    known = {"map": FLAT, "intrinsics": camera, "gravity": gravity}
    head = f'--{EDGE}\r\nContent-Disposition: form-data; name="'
    body = f'{head}request"\r\n\r\n{json.dumps(known)}\r\n{head}images"; filename="a"\r\n\r\n'
    data = body.encode() + path.read_bytes() + f"\r\n--{EDGE}--\r\n".encode()
    return Request("POST", "/v1/localize", data, f"multipart/form-data; boundary={EDGE}")


def watched(
    server: Served, file: Path, texts: list[str], requests: int, seconds: int
) -> list[dict[str, Any]]:
    """Memory before, and from time to time, of many requests: of 20 one is a sentence, others cheap."""
    mixed = [
        request
        for text in texts
        for request in (
            Request.of("/v1/locate", text=text, map=CITY),
            *[Request("GET", "/healthz")] * 6,
            *[Request("GET", "/v1/maps")] * 4,
            *[Request("GET", "/")] * 2,
            *[Request("GET", f"/v1/maps/{CITY}/drawing")] * 2,
            *[Request.of("/v1/locate", text="", map=CITY)] * 3,
            Request("GET", "/api?q=bakery"),
            Request("GET", "/metrics"),
        )
    ]
    rows = [{"requests": 0, "mb": server.memory()}]
    while rows[-1]["requests"] < requests:
        seen = server.asked(mixed, file, at_once=4, seconds=seconds)
        total = rows[-1]["requests"] + seen["requests"]
        rows.append({"requests": total, "mb": server.memory(), "cpu_ms": seen["cpu_ms"]})
    return rows


def line(row: dict[str, Any]) -> list[str]:
    """A row of the table."""
    numbers = (number(row[k], 1) for k in ("per_second", "p50_ms", "p95_ms", "cpu_ms"))
    return [row["asked"], str(row["at_once"]), *numbers, str(row["failed"])]


def told(sockets: dict[str, Any], memory: list[dict[str, Any]]) -> str:
    """What idle WebSockets and many requests did to memory."""
    some = memory[:2] + memory[2 :: max(1, len(memory) // 5)]
    grown = ", ".join(f"{row['mb']:.0f} after {row['requests']:,}" for row in some)
    return (
        f"{sockets['sockets']} idle WebSockets hold {sockets['mb']:.1f} MB, and the last is answered "
        f"in {sockets['s'] * 1e3:.0f} ms. MB of all processes: {grown} requests."
    )
