"""Tiny scans of 3RScan in the published layout: a textured mesh, labels of its vertices, a recording."""

import io
import json

import numpy as np
from PIL import Image
from tests.io.writers import ply

INFO = """m_depthShift = 1000
m_colorWidth = {c.width}
m_colorHeight = {c.height}
m_depthWidth = {d.width}
m_depthHeight = {d.height}
m_calibrationColorIntrinsic = {c.fx} 0 {cx} 0 0 {c.fy} {cy} 0 0 0 1 0 0 0 0 1
m_calibrationDepthIntrinsic = {d.fx} 0 {dx} 0 0 {d.fy} {dy} 0 0 0 1 0 0 0 0 1
m_frames.size = {n}
"""


def write_scan(root, name, scene, capture, scan_from_camera):
    """A scan's folder of a scene map's mesh, each object in one colour, and a capture through it."""
    folder = root / name
    folder.mkdir(parents=True)
    mesh, graph = scene.mesh, scene.graph
    points = mesh.vertices[mesh.triangles].reshape(-1, 3)
    of = np.repeat(mesh.object_of, 3)
    ids = of + 1
    faces = np.arange(len(points)).reshape(-1, 3)
    lines = ["mtllib mesh.refined.mtl"]
    lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points]
    lines += [f"vt {(i + 0.5) / len(graph):.6f} 0.5" for i in of]
    lines += ["usemtl one", *("f " + " ".join(f"{i}/{i}" for i in face + 1) for face in faces)]
    (folder / "mesh.refined.v2.obj").write_text("\n".join(lines) + "\n")
    (folder / "mesh.refined.mtl").write_text("newmtl one\nKd 1 1 1\nmap_Kd mesh.refined_0.png\n")
    palette = np.random.default_rng(0).integers(0, 256, (len(graph), 3))
    picture = np.repeat(palette.astype(np.uint8)[None], 4, axis=0).repeat(4, axis=1)
    Image.fromarray(picture).save(folder / "mesh.refined_0.png")
    rows = [(*xyz, i) for xyz, i in zip(points.round(6).tolist(), ids.tolist(), strict=True)]
    vertices = ("vertex", dict.fromkeys("xyz", "float") | {"objectId": "ushort"}, rows)
    corners = ("face", {"vertex_indices": "uchar int"}, [(face,) for face in faces.tolist()])
    (folder / "labels.instances.annotated.v2.ply").write_bytes(ply("ascii", vertices, corners))
    groups = [
        {"id": i + 1, "objectId": i + 1, "label": label, "segments": [i]}
        for i, label in enumerate(graph.labels)
    ]
    (folder / "semseg.v2.json").write_text(json.dumps({"scan_id": name, "segGroups": groups}))
    _write_sequence(folder / "sequence", capture, scan_from_camera)


def _write_sequence(folder, capture, scan_from_camera):
    folder.mkdir()
    c, d = capture.camera, capture.depth_camera
    centres = {"cx": c.cx - 0.5, "cy": c.cy - 0.5, "dx": d.cx - 0.5, "dy": d.cy - 0.5}
    (folder / "_info.txt").write_text(INFO.format(c=c, d=d, n=len(capture), **centres))
    for i, (frame, pose) in enumerate(zip(capture, scan_from_camera, strict=True)):
        stem, file = folder / f"frame-{i:06d}", io.BytesIO()
        Image.fromarray(frame.rgb()).save(file, "JPEG", quality=95)
        (folder / f"{stem.name}.color.jpg").write_bytes(file.getvalue())
        units = np.nan_to_num(frame.depth() * 1000).astype(">u2")
        head = f"P5 {d.width} {d.height} 65535\n".encode()
        (folder / f"{stem.name}.depth.pgm").write_bytes(head + units.tobytes())
        np.savetxt(folder / f"{stem.name}.pose.txt", pose)


def write_rooms(root, rooms, kind="validation"):
    """`3RScan.json` of rooms, lists of scans of which the first is the reference, all aligned."""
    aligned = np.eye(4).ravel().tolist()
    content = [
        {"reference": first, "type": kind, "scans": [{"reference": s, "transform": aligned} for s in rest]}
        for first, *rest in rooms
    ]  # fmt: skip
    (root / "3RScan.json").write_text(json.dumps(content))
    (root / "files").mkdir()
    (root / "files/test_resplit_scans.txt").write_text("\n".join(first for first, *_ in rooms))
