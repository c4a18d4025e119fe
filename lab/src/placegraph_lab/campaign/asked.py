"""What people, programs and shells ask: texts in all languages, requests, messages, command lines."""

from __future__ import annotations

import base64
import io
import json
import re
from contextlib import chdir, suppress
from pathlib import Path

from numpy.random import Generator
from PIL import Image

from placegraph_lab.campaign.mutate import spoil
from placegraph_lab.campaign.mutate_bytes import WORDS, flipped
from placegraph_lab.campaign.seeds import ROOT, save
from placegraph_lab.campaign.seeds_maps import POSE, Places
from placegraph_lab.campaign.uses import INSIDE, SAID, Bench, chance

MARKS = re.compile(r" => .*| @\d+.*")  # what the tests expect of a sentence stands behind it
ODD = ("\u202e", "\x1b[2J", "\0", "\ud800", "½", "٣", "\U0001f468\u200d\U0001f469", "\n\n", "://",
       "ß" * 40, "9" * 5000, "not", "no", "and", "between", "(", ")", '"', "300 m", "-5 km",
       "1e400 m", "north of", "I", "𝔞")  # fmt: skip


def sentences() -> list[str]:
    """Sentences of all languages, as the tests have them."""
    found = [*SAID, *INSIDE]
    for path in sorted((ROOT / "tests/outdoor/language/hand").glob("*.txt")):
        lines = path.read_text("utf-8").splitlines()
        found += [MARKS.sub("", line) for line in lines if line.strip() and line[0] != "#"]
    for name in ("sentences", "human", "turns"):
        lines = (ROOT / f"tests/outdoor/language/{name}.txt").read_text("utf-8").splitlines()
        found += [line.partition(" | ")[0] for line in lines if line and line[0] not in " #"]
    return found


def texts(path: Path, _places: Places) -> None:
    """All sentences, one a line."""
    path.write_text("\n".join(sentences()), "utf-8")


def reworded(path: Path, rng: Generator) -> None:
    """One to three sentences of the file, with words of them exchanged, doubled, gone, or odd."""
    lines = path.read_text("utf-8").split("\n")
    chosen = [lines[i] for i in rng.integers(len(lines), size=int(rng.choice([1, 1, 2, 3])))]
    words = re.findall(r"\w+\s*|\W\s*", " ".join(chosen))
    for _ in range(int(rng.choice([1, 2, 4, 9]))):
        at, kind = int(rng.integers(len(words) + 1)), int(rng.integers(6))
        if kind == 0:
            words[at : at + 1] = []
        elif kind == 1:
            words[at:at] = words[int(rng.integers(len(words) + 1)) :][:4]
        elif kind == 2:
            other = re.findall(r"\w+\s*|\W\s*", lines[rng.integers(len(lines))])
            words[at:at] = other[: int(rng.integers(1, 6))]
        elif kind == 3:
            words[at : at + 1] = [f"{ODD[rng.integers(len(ODD))]} "]
        elif kind == 4:
            rng.shuffle(words)
        else:
            words = words * int(rng.choice([2, 30]))
    text = "".join(words)[:20_000].encode("utf-8", "surrogatepass")
    path.write_bytes(flipped(text, rng) if chance(rng, 0.2) else text)


def describe(bench: Bench, path: Path, rng: Generator) -> None:
    """Read a text of the outside and of the inside, and look for the place."""
    from placegraph.indoor.language import rank_scenes
    from placegraph.outdoor.language import describe as read

    text = path.read_bytes().decode("utf-8", "surrogateescape" if chance(rng, 0.1) else "replace")
    text = text if chance(rng, 0.01) else text[:400]
    kind = int(rng.integers(6))
    if kind < 3:
        repr(read(text, heading=0.5 if kind else None))
    elif kind == 3:
        rank_scenes(text, [bench.room, bench.room])
    elif kind == 4:
        bench.kleinstadt.locate(text, top=2).to_dict()
    else:
        bench.kleinstadt.track().tell(text)


# ---------------------------------------------------------------------------------------- requests


def requests(folder: Path, places: Places) -> None:
    """A file a request: method, path, body; multipart and base64 as a client would make them."""
    folder.mkdir()
    frame = places.frames[0]
    array = frame.rgb()
    out = io.BytesIO()
    Image.fromarray(array).save(out, "PNG")
    image = base64.b64encode(out.getvalue()).decode()
    fix = {"latitude": 53.0, "longitude": 8.0, "accuracy": 5.0}
    camera = {"sensorId": "0", "timestamp": 1608995990413, "imageBytes": image, "imageFormat": "PNG",
              "size": [48, 36], "params": {"model": "PINHOLE", "modelParams": [35, 35, 24, 18]}}  # fmt: skip
    sensed = {"cameraReadings": [camera],
              "geolocationReadings": [fix | {"sensorId": "1", "timestamp": 1}],
              "accelerometerReadings": [{"x": 0, "y": 9.8, "z": 0, "sensorId": "2"}]}  # fmt: skip
    asked = {
        "locate": ("POST", "/v1/locate", {"text": SAID[0], "near": [8.0, 53.0], "radius": 200.0, "top": 3,
                                          "heading_deg": 90, "map": "town", "answers": []}),
        "search": ("GET", "/api?q=Hotel%20Hansa&lat=53.0&lon=8.0&limit=5", None),
        "geopose": ("POST", "/geopose", {"id": "a", "timestamp": 1608995990413, "type": "geopose",
                    "sensors": [{"id": "0", "type": "camera"}], "sensorReadings": sensed,
                    "priorPoses": []}),
        "begin": ("POST", "/v1/sessions", {"map": "town", "near": [8.0, 53.0], "radius": 100.0}),
        "camera": ("POST", "/v1/sessions", {"map": "room", "camera": {"fx": 35, "width": 48, "height": 36},
                   "description": INSIDE[0]}),
        "step": ("STEP", "town", {"text": SAID[0], "east": 3.0, "north": 1.0, "sigma": 2.0}),
        "frame": ("STEP", "room", {"image": image, "gravity": [0, 1, 0],
                  "odometry": POSE.tolist(), "stamp": 1.0}),
        "live": ("SOCKET", "/v1/live", {"id": 3, "text": SAID[1], "top": 2}),
        "localize": ("FORM", "/v1/localize", {"map": "room", "gravity": [[0, 1, 0]], "depth_scale": 1000.0,
                     "intrinsics": {"fx": 35.0, "cx": 24.0, "cy": 18.0, "width": 48, "height": 36},
                     "prior": {"x": 2.5, "y": 0.2, "spread": 0.5}, "description": INSIDE[1],
                     "near": [8.0, 53.0], "pictures": []}),
        "plan": ("GET", "/v1/maps/room/plan.png", None),
        "maps": ("GET", "/v1/maps", None),
    }  # fmt: skip
    for name, (method, path, body) in asked.items():
        content = {"method": method, "path": path, "body": body, "accept": "*/*"}
        (folder / f"{name}.request").write_text(json.dumps(content), "utf-8")
    save(folder / "image.png", frame.rgb())


def one(folder: Path, rng: Generator) -> None:
    """One of the requests or messages changed, and the others taken away; at times its image changed."""
    image = folder / "image.png"
    asked = sorted(p for p in folder.iterdir() if p != image)
    chosen = asked[rng.integers(len(asked))]
    for path in asked:
        if path != chosen:
            path.unlink()
    spoil(image if image.exists() and chance(rng, 0.15) else chosen, rng)


def messages(folder: Path, _places: Places) -> None:
    """Requests as they go over the wire."""
    folder.mkdir()
    body = json.dumps({"text": SAID[0], "map": "town"}).encode()
    head = b"Host: 127.0.0.1\r\nContent-Type: application/json\r\n"
    form = b'--xx\r\nContent-Disposition: form-data; name="images"; filename="a.png"\r\n\r\nabc\r\n--xx--\r\n'
    kinds = {
        "post": b"POST /v1/locate HTTP/1.1\r\n" + head + b"Content-Length: %d\r\n\r\n" % len(body) + body,
        "chunks": b"POST /v1/locate HTTP/1.1\r\n" + head + b"Transfer-Encoding: chunked\r\n\r\n"
                  + b"%x\r\n" % len(body) + body + b"\r\n0\r\n\r\n",
        "get": b"GET /api?q=bench HTTP/1.1\r\nHost: 127.0.0.1\r\nAccept: */*\r\n\r\n",
        "form": b"POST /v1/localize HTTP/1.1\r\nHost: 127.0.0.1\r\n"
                b"Content-Type: multipart/form-data; boundary=xx\r\n"
                b"Content-Length: %d\r\n\r\n" % len(form) + form,
        "socket": b"GET /v1/live HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                  b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
                  b'\x81\x8a\0\0\0\0{"text":1}',
        "geopose": b"POST /geopose HTTP/1.1\r\nHost: 127.0.0.1\r\n"
                   b"Accept: application/vnd.oscp+json; version=2.0\r\n"
                   b'Content-Length: 22\r\n\r\n{"sensorReadings": []}',
    }  # fmt: skip
    for name, data in kinds.items():
        (folder / f"{name}.http").write_bytes(data)


# ---------------------------------------------------------------------------------- command lines

COMMANDS = (
    "city build town.osm -o out.city --cell-size 50 --stride 25", "city info town.city --json",
    "city locate town.city TEXT --top 3 --near 8.0,53.0 --radius 100 --json",
    "city locate town.city TEXT --matcher transformer --candidates-by all --candidates 5",
    "city locate town.city TEXT --png out.png --heading-deg 90 --language de", "city check town.city",
    "city locate town.city TEXT --html out.html --preset paper", "city track town.city --json",
    "city embed town.city -o out.vectors --bits 8", "scene info room.scene --png out.png",
    "scene build room.glb -o out.scene --floor 0 --up z --scale 1 --detail small", "scene check room.scene",
    "scene anchor room.scene -o out.scene --pose 8.0,53.0,6.4,17 --accuracy 1,3 --level 2",
    "scene anchor room.scene -o out.scene --pair 0,0=8,53 --pair 5,0=8.0001,53 --pair 0,4=8,53.0001",
    "scene localize room.scene walk --frames 0:2 --no-refine --near 2,1 --radius 1 --height 1.5 --json",
    "scene render room.scene --out out --pose 2.5,0.2,1.5,90 --size 48,36", "scene export room.scene out.glb",
    "scene diff room.scene room.scene -o out.json", "library build room.scene -o out.library",
    "library search rooms.library TEXT --most 3 --json", "library info rooms.library", "bag info walk",
    "locate . TEXT --near 8.0,53.0 --radius 200 --json", "scene export room.scene out.osm --overwrite",
    "scene encode room.scene -o out.scene --encoder labels:x=1", "--version", "scene --help",
)  # fmt: skip


def commands(folder: Path, places: Places) -> None:
    """A folder with maps of all kinds, and a file with command lines."""
    folder.mkdir()
    places.city(folder)
    places.room.save(folder / "room.scene")
    places.room.export(folder / "room.glb")
    from placegraph.indoor.library import library_of

    library = library_of({}, encoders="labels")
    library.add("room", folder / "room.scene")
    library.save(folder / "rooms.library")
    (folder / "words").write_text("\n".join(COMMANDS), "utf-8")


def misspoken(folder: Path, rng: Generator) -> None:
    """One command line, with words exchanged, and with numbers and options that are none."""
    lines = [line.split() for line in (folder / "words").read_text("utf-8").split("\n")]
    words = lines[rng.integers(len(lines))]
    for _ in range(int(rng.choice([1, 1, 2, 3]))):
        at, kind = int(rng.integers(1, len(words) + 1)), int(rng.integers(5))
        if kind < 2 and at < len(words):
            odd = WORDS[rng.integers(len(WORDS))].decode("utf-8", "surrogateescape")
            parts = re.split(r"([,:=])", words[at])
            parts[rng.integers(len(parts))] = odd.replace("\0", "")
            words[at] = "".join(parts)
        elif kind == 2:
            words[at : at + 1] = []
        elif kind == 3:
            other = lines[rng.integers(len(lines))]
            words[at:at] = other[-2:]
        else:
            words[at:at] = words[at : at + 2]
    (folder / "words").write_text("\0".join(words), "utf-8", "surrogateescape")


def command(_bench: Bench, folder: Path, _rng: Generator) -> None:
    """Run a command line in its folder; `SystemExit` with 0 where it was taken."""
    import sys

    from placegraph import cli

    words = (folder / "words").read_text("utf-8", "surrogateescape").split("\0")
    sys.argv = ["placegraph", *(SAID[0] if w == "TEXT" else w for w in words)]
    before, sys.stdin = sys.stdin, io.StringIO("\n".join(SAID))
    try:
        with chdir(folder), suppress(BrokenPipeError):
            cli.main()
    finally:
        sys.stdin = before
