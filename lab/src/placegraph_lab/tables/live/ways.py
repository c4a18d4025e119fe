"""From a frame to its pose by each way in: a folder, a bag, and a server's WebSocket."""

from __future__ import annotations

import asyncio
import base64
import json
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter, process_time
from typing import Any
from urllib.request import Request, urlopen

from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import open_capture
from placegraph_lab.tables.live.paced import quantiles
from placegraph_lab.tables.live.walks import SENSES
from placegraph_lab.tables.serve.load import Served, served
from placegraph_lab.worlds.bags import BagWriter, Layout, write_capture


def from_files(scene: SceneMap, paths: Sequence[Path]) -> dict[str, Any]:
    """Captures or bags, a new tracker each: reading an image, and all until its pose is there."""
    wall, cpu, sure = [], [], 0
    for number, path in enumerate([paths[0], *paths]):  # the first warms
        live = scene.live(options=SENSES, background=False)
        capture = open_capture(path)
        for row in range(len(capture)):
            start, spent = perf_counter(), process_time()
            told = live.step(capture[row])
            if number:
                wall.append(perf_counter() - start)
                cpu.append(process_time() - spent)
                sure += told.status.name == "OK"
    return figures(wall, cpu, sure)


def bags(paths: Sequence[Path], folder: Path) -> list[Path]:
    """The same captures as MCAP, raw images."""
    out = []
    for path in paths:
        with BagWriter(folder / path.name) as writer:
            write_capture(writer, open_capture(path, labels=None), Layout())
        out.append(folder / path.name)
    return out


def from_server(maps: Path, paths: Sequence[Path]) -> dict[str, Any]:
    """Images sent over WebSockets to sessions of a server beside us, until each answer is there."""
    with served(maps) as server:
        asyncio.run(_session(server, paths[0]))
        wall: list[float] = []
        sure, spent = 0, server.cpu()
        for path in paths:
            found = asyncio.run(_session(server, path))
            wall += [seconds for seconds, _ in found]
            sure += sum(status == "OK" for _, status in found)
        each = (server.cpu() - spent) / len(wall)
    return figures(wall, [each], sure)


async def _session(server: Served, path: Path) -> list[tuple[float, str]]:
    from websockets.asyncio.client import connect

    capture = open_capture(path, labels=None)
    c = capture.camera
    camera = {n: getattr(c, n) for n in ("fx", "fy", "cx", "cy", "width", "height")}
    begun = await asyncio.to_thread(_post, f"{server.url}/v1/sessions", {"camera": camera})
    address = f"{server.url.replace('http', 'ws')}/v1/sessions/{begun['session']}"
    found = []
    async with connect(address, ping_interval=None, max_size=None) as socket:
        rows = zip(
            sorted((path / "rgb").iterdir()), sorted((path / "depth").iterdir()), strict=True
        )
        for frame, (colours, depth) in zip(capture, rows, strict=True):
            start = perf_counter()
            await socket.send(json.dumps({
                "image": base64.b64encode(colours.read_bytes()).decode(),
                "depth": base64.b64encode(depth.read_bytes()).decode(),
                "odometry": frame.odometry.tolist(), "gravity": frame.gravity.tolist(),
                "stamp": frame.stamp,
            }))  # fmt: skip
            answer = json.loads(await socket.recv())
            found.append((perf_counter() - start, answer["estimate"]["status"]))
    return found


def _post(url: str, body: dict[str, Any]) -> dict[str, Any]:
    kind = {"Content-Type": "application/json"}
    request = Request(url, json.dumps(body).encode(), kind)  # noqa: S310  # our own server
    with urlopen(request, timeout=60) as answer:  # noqa: S310
        told: dict[str, Any] = json.loads(answer.read())
        return told


def figures(wall: list[float], cpu: list[float], sure: int) -> dict[str, Any]:
    """Of one way in."""
    told = {"frames": len(wall), "sure": sure / len(wall), "wall_ms": quantiles(wall)}
    return told | {"cpu_ms": quantiles(cpu), "in_time": sum(s <= 0.1 for s in wall) / len(wall)}
