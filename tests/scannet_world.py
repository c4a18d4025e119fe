"""A tiny ScanNet in the published layout: annotated meshes, .sens recordings, exported frames."""

import io
import json
import struct
import zlib

import numpy as np
from PIL import Image
from tests.io.writers import ply

from placegraph.core.geometry import rotation_z

NAME = "scene0000_00"
DRAWING = """
wwwwwwww
ffffffff
fftttfcf
fftttfff
ffffffff
"""
METRES = 0.5
HEIGHT = {"w": 2.0, "f": 0.0, "t": 0.7, "c": 0.45}
COLOUR = {"w": (200, 190, 180), "f": (120, 80, 40), "t": (150, 30, 30), "c": (20, 90, 160)}
OBJECTS = {"f": (0, "floor"), "t": (4, "dining table"), "c": (2, "office chair")}  # walls: nobody's
NYU40 = {"w": 1, "f": 2, "t": 7, "c": 5}
SCAN_FROM_MAP = np.eye(4)
SCAN_FROM_MAP[:3, :3] = rotation_z(0.6)
SCAN_FROM_MAP[:3, 3] = (1.5, -2.0, 0.125)
COLUMNS = "id\traw_category\tcategory\tcount\tnyu40id\tnyu40class"
ROWS = (
    "1\tfloor\tfloor\t9\t2\tfloor",
    "2\toffice chair\tchair\t8\t5\tchair",
    "3\tdining table\ttable\t7\t7\ttable",
    "1163\tobject\t\t1\t\t",
)


def moved(matrix, points):
    return points @ matrix[:3, :3].T + matrix[:3, 3]


class Mesh:
    """Level squares of the drawing; what squares of one letter share is one vertex."""

    def __init__(self, drawing=DRAWING):
        lines = drawing.split()
        number, points, self.letters, self.segments, triangles = {}, [], [], [], []
        for row, line in enumerate(lines):
            for column, letter in enumerate(line):
                corners = []
                for dr, dc in ((0, 0), (1, 0), (1, 1), (0, 1)):
                    key = (row + dr, column + dc, letter)
                    if key not in number:
                        number[key] = len(points)
                        x, y = (column + dc) * METRES, (len(lines) - row - dr) * METRES
                        points.append((x, y, HEIGHT[letter]))
                        self.letters.append(letter)
                        self.segments.append(1000 * ord(letter) + row)
                    corners.append(number[key])
                a, b, c, d = corners
                triangles += [(a, b, c), (a, c, d)]
        self.points = np.array(points)
        self.triangles = np.array(triangles)
        self.colours = np.array([COLOUR[letter] for letter in self.letters], np.uint8)
        self.groups = [
            {"id": i, "objectId": i, "label": label, "segments": self.segments_of(letter)}
            for letter, (i, label) in OBJECTS.items()
        ]

    def segments_of(self, letter):
        return sorted(
            {s for s, own in zip(self.segments, self.letters, strict=True) if own == letter}
        )


def encode_ply(points, colours, triangles, label=None):
    """Bytes as ScanNet's own files have them, with alpha, and a label where they have one."""
    properties = dict.fromkeys("xyz", "float")
    properties |= dict.fromkeys(("red", "green", "blue", "alpha"), "uchar")
    properties |= {"label": "ushort"} if label is not None else {}
    labels = np.zeros((len(points), 0)) if label is None else np.reshape(label, (-1, 1))
    rows = np.hstack([points, colours, np.full((len(points), 1), 255), labels]).tolist()
    rows = [(*row[:3], *map(int, row[3:])) for row in rows]
    faces = [(corners,) for corners in triangles.tolist()]
    return ply(
        "binary_little_endian",
        ("vertex", properties, rows), ("face", {"vertex_indices": "uchar int"}, faces),
    )  # fmt: skip


class ObjectMesh:
    """A scene map's mesh; every object is a segment of vertices of its own."""

    def __init__(self, scene):
        mesh = scene.mesh
        self.points = mesh.vertices[mesh.triangles].reshape(-1, 3).astype(np.float64)
        self.triangles = np.arange(len(self.points)).reshape(-1, 3)
        self.colours = mesh.colours[mesh.triangles].reshape(-1, 3)
        self.segments = np.repeat(mesh.object_of + 100, 3).tolist()
        self.groups = [
            {"id": i, "objectId": i, "label": label, "segments": [i + 100]}
            for i, label in enumerate(scene.graph.labels)
        ]


class Scan:
    """One scan's folder; tests spoil what they like."""

    def __init__(self, folder, mesh=None, name=NAME):
        self.folder, self.name = folder, name
        folder.mkdir(parents=True, exist_ok=True)
        self.mesh = mesh or Mesh()
        self.points = moved(SCAN_FROM_MAP, self.mesh.points)
        self.groups = self.mesh.groups
        self.write_mesh("_vh_clean_2.ply")
        self.write_segments("_vh_clean_2.0.010000.segs.json")
        self.write_groups(".aggregation.json")
        self.write_meta(np.linalg.inv(SCAN_FROM_MAP))

    def file(self, ending):
        return self.folder / f"{self.name}{ending}"

    def text(self, ending, text):
        self.file(ending).write_text(text, encoding="utf-8")
        return self.file(ending)

    def json(self, ending, content):
        return self.text(ending, json.dumps(content))

    def write_mesh(self, ending, **columns):
        data = encode_ply(self.points, self.mesh.colours, self.mesh.triangles, **columns)
        self.file(ending).write_bytes(data)
        return self.file(ending)

    def write_labels(self):
        label = [NYU40[letter] for letter in self.mesh.letters]
        return self.write_mesh("_vh_clean_2.labels.ply", label=label)

    def write_segments(self, ending, segments=None):
        indices = self.mesh.segments if segments is None else segments
        params = {"kThresh": "0.0001", "segMinVerts": "20"}
        return self.json(ending, {"params": params, "sceneId": self.name, "segIndices": indices})

    def write_groups(self, ending, groups=None):
        listed = self.groups if groups is None else groups
        return self.json(
            ending, {"sceneId": f"scannet.{self.name}", "appId": "test", "segGroups": listed}
        )

    def write_meta(self, alignment, **more):
        said = " ".join(f"{v:.6f}" for v in np.ravel(alignment))
        values = {"appVersionId": "47", "axisAlignment": f"{said} ", **more, "sceneType": "Office"}
        return self.text(".txt", "".join(f"{k} = {v}\n" for k, v in values.items()))

    def write_table(self, rows=ROWS):
        path = self.folder.parent / "scannetv2-labels.combined.tsv"
        path.write_text("\n".join([COLUMNS, *rows]) + "\n", encoding="utf-8")
        return path


LOST = np.full((4, 4), -np.inf)
COLOUR_K = (10.0, 11.0, 3.5, 2.5)
DEPTH_K = (5.0, 5.5, 1.5, 1.0)


def intrinsic(fx, fy, cx, cy):
    return np.array([[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64)


def poses(count, lost=()):
    """(T, 4, 4) of an upright camera that steps along x of the scan's axes."""
    found = np.zeros((count, 4, 4))
    found[:, :3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    found[:, :3, 3] = [(0.25 * i, 1.0, 1.5) for i in range(count)]
    found[:, 3, 3] = 1.0
    found[list(lost)] = LOST
    return found


class Recording:
    """Frames of 8 x 6 with depth of 4 x 3, or others, written as a .sens file or as exported files."""

    def __init__(self, count=5, lost=(2,), seed=0):
        rng = np.random.default_rng(seed)
        self.colour = rng.integers(0, 256, (count, 6, 8, 3)).astype(np.uint8)
        self.depth = rng.integers(1, 5000, (count, 3, 4)).astype("<u2")
        self.depth[:, 0, 0] = 0
        self.poses = poses(count, lost)
        self.stamps = [5_000_000 + 33_333 * i for i in range(count)]
        self.lost = set(lost)
        self.extrinsics = (np.eye(4), np.eye(4))
        self.intrinsics = (COLOUR_K, DEPTH_K)

    @classmethod
    def of(cls, capture, scan_from_camera):
        """Recording of another capture's images, with these poses (T, 4, 4)."""
        self = cls(len(capture), lost=())
        self.colour = np.stack([frame.rgb() for frame in capture])
        depth = np.stack([frame.depth() for frame in capture])
        self.depth = np.rint(np.nan_to_num(depth) * 1000).astype("<u2")
        self.poses = scan_from_camera
        self.intrinsics = [
            (c.fx, c.fy, c.cx - 0.5, c.cy - 0.5) for c in (capture.camera, capture.depth_camera)
        ]
        return self

    def coded_colour(self, i, coding):
        if coding == 0:
            return self.colour[i].tobytes()
        file = io.BytesIO()
        Image.fromarray(self.colour[i]).save(file, {1: "PNG", 2: "JPEG"}[coding])
        return file.getvalue()

    def coded_depth(self, i, coding):
        data = self.depth[i].tobytes()
        return zlib.compress(data) if coding == 1 else data

    def sens(
        self, *, version=4, colour=1, depth=1, shift=1000.0, count=None, inertial=2, sides=None
    ):
        """Bytes of the file; `colour` and `depth` are its codings."""
        sensor = b"StructureSensor"
        out = struct.pack("<IQ", version, len(sensor)) + sensor
        for k, extrinsic in zip(self.intrinsics, self.extrinsics, strict=True):
            out += intrinsic(*k).astype("<f4").tobytes() + extrinsic.astype("<f4").tobytes()
        sides = sides or (*self.colour.shape[2:0:-1], *self.depth.shape[2:0:-1])
        out += struct.pack("<ii4If", colour, depth, *sides, shift)
        out += struct.pack("<Q", len(self.poses) if count is None else count)
        for i, pose in enumerate(self.poses):
            image, metres = self.coded_colour(i, colour), self.coded_depth(i, depth)
            out += pose.astype("<f4").tobytes()
            out += struct.pack("<4Q", self.stamps[i], self.stamps[i], len(image), len(metres))
            out += image + metres
        return out + struct.pack("<Q", inertial) + b"\0" * (128 * inertial)

    def write_sens(self, path, **options):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(self.sens(**options))
        return path

    def export(self, folder, *, intrinsics="intrinsic/intrinsic_{}.txt", digits=1):
        """`color/0.png`, `depth/0.png`, `pose/0.txt` and intrinsics, as SensReader writes them."""
        for name in ("color", "depth", "pose", "intrinsic"):
            (folder / name).mkdir(parents=True, exist_ok=True)
        for name, k in zip(("color", "depth"), self.intrinsics, strict=True):
            np.savetxt(folder / intrinsics.format(name), intrinsic(*k), fmt="%f")
        for i, pose in enumerate(self.poses):
            stem = f"{i:0{digits}d}"
            Image.fromarray(self.colour[i]).save(folder / "color" / f"{stem}.png")
            Image.fromarray(self.depth[i]).save(folder / "depth" / f"{stem}.png")
            np.savetxt(folder / "pose" / f"{stem}.txt", pose, fmt="%f")
        return folder

    def project(self, folder, name, values, dtype):
        """Label images `name/0.png` of whole numbers (T, H, W)."""
        (folder / name).mkdir(parents=True, exist_ok=True)
        for i, image in enumerate(np.asarray(values, dtype)):
            Image.fromarray(image).save(folder / name / f"{i}.png")
