"""How answers are told in plain numbers, rounded, kept in files and compared."""

import hashlib
import json
from dataclasses import fields

import numpy as np

DIGITS = {
    "at": 6,  # longitude, latitude [deg]
    "gain": 4,  # [nat]
    "kB": 1,
    "p": 4,
    "pose": 4,  # x, y, z [m], turn [rad]
    "print": 5,  # of arrays: see `fingerprint`
    "about": 3,  # of arrays that are rounded otherwise by other threads
    "sigma": 4,  # [m], [rad]
    "sigma_m": 2,
    "weight": 3,  # log-likelihood ratios [nat]
}
"""Decimals that are kept of the numbers under a name; all other things are compared exactly."""


def differences(kept, new, name="", digits=None):
    """Where two answers differ, in words; numbers may differ by one in their last decimal."""
    if isinstance(kept, dict) and isinstance(new, dict):
        for key in sorted(kept.keys() | new.keys()):
            if key in kept and key in new:
                inner = DIGITS.get(key, digits)
                yield from differences(kept[key], new[key], f"{name}/{key}", inner)
            else:
                yield f"{name}/{key}: {'is gone' if key in kept else 'is new'}"
    elif isinstance(kept, list) and isinstance(new, list) and len(kept) == len(new):
        for i, (a, b) in enumerate(zip(kept, new, strict=True)):
            yield from differences(a, b, f"{name}/{i}", digits)
    elif isinstance(kept, float) and isinstance(new, float) and digits is not None:
        if not abs(kept - new) < 1.5 * 10.0**-digits:
            yield f"{name}: {kept} became {new}"
    elif kept != new or type(kept) is not type(new):
        yield f"{name}: {kept!r} became {new!r}"


def plain(answer, digits=None):
    """Lists, dicts, numbers and strings; numbers rounded as their name says."""
    if isinstance(answer, dict):
        return {k: plain(v, DIGITS.get(k, digits)) for k, v in answer.items()}
    if isinstance(answer, list | tuple | np.ndarray):
        return [plain(v, digits) for v in answer]
    if isinstance(answer, float | np.floating):
        assert digits is not None, f"{answer} has no name that says how exact it is"
        return round(float(answer), digits) + 0.0
    return answer.item() if isinstance(answer, np.generic) else answer


def read(path):
    return json.loads(path.read_text(encoding="utf-8"))


def write(path, answers):
    """One answer a line, so that a change shows as lines."""
    rows = [f"{json.dumps(k)}: {json.dumps(v, ensure_ascii=False)}" for k, v in answers.items()]
    path.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")


def fingerprint(values, name="print"):
    """Shape and hash of whole numbers and texts; of other numbers a weighted sum instead.

    Of the sum, which is over the largest number, the order of summation changes nothing that is kept.
    """
    array = np.asarray(values)
    if array.dtype.kind != "f":
        text = repr(array.tolist()).encode()
        return [*array.shape, hashlib.sha256(text).hexdigest()[:12]]
    flat = np.nan_to_num(array.astype(np.float64).ravel(), nan=-1.0, posinf=-2.0)
    weights = np.sin(1.618 * np.arange(flat.size) + 1.0)
    most = max(1.0, float(np.abs(flat).max(initial=0.0)))
    return {"shape": list(array.shape), name: [most, float(flat @ weights) / most]}


def fingerprints(columns, but=()):
    """Fingerprints of the columns of a dataclass."""
    told = {}
    for f in fields(columns):
        value = getattr(columns, f.name)
        if f.name not in but and value is not None:
            told[f.name] = fingerprint(value)
    return told


def scene_content(scene):
    """What a scene map holds."""
    textures = scene.mesh.textures
    told = {
        "objects": len(scene),
        "graph": fingerprints(scene.graph),
        "mesh": fingerprints(scene.mesh, but=("textures",)),
        "textures": [
            len(textures),
            fingerprint(np.concatenate([t.ravel() / 255.0 for t in textures])),
        ],
        "attributes": fingerprint(repr([sorted(a.items()) for a in scene.attributes])),
        "rooms": sorted({a.get("room", "") for a in scene.attributes}),
        "pose": [float(f) for f in scene.floors],
    }
    return told | {"scenes": list(scene.scenes), "encoder": scene.encoder}


def findings(scene):
    """What `check` finds."""
    return [[f.severity, *f.objects] for f in scene.check()]


def evidence(mode, most=None):
    return [
        {"says": e.verdict, "weight": e.weight, "of": [o.id for o in e.objects]}
        for e in mode.evidence[:most]
    ]


def city_estimate(estimate, most=3):
    """A `CityEstimate`: verdict, places, evidence of the best, how far the text was understood."""
    told = {
        "status": estimate.status.name,
        "modes": [
            {"at": [m.longitude, m.latitude], "p": m.probability, "cell": m.cell}
            for m in estimate.modes[:most]
        ],
    }
    if estimate.understood is not None:
        said = estimate.understood
        told["read"] = [len(said.mentions), len(said.statements), len(said.ignored)]
    if estimate.best is not None:
        told["sigma_m"] = np.sqrt(np.abs(estimate.best.covariance.ravel()))
        told["evidence"] = evidence(estimate.best)
    return told


def pose_estimate(estimate, most=3):
    """A `PoseEstimate`: verdict, poses, evidence of the best, first pose of the way, refinement."""
    told = {
        "status": estimate.status.name,
        "modes": [
            {"pose": m.pose, "p": m.probability, "scene": m.scene} for m in estimate.modes[:most]
        ],
        "frames": [len(estimate.frames), int(estimate.frames.sum())],
    }
    if estimate.best is not None:
        best = estimate.best
        told["axis"] = {"pose": best.map_from_camera[:3, 2]}
        told["sigma"] = np.sqrt(np.diag(best.covariance))
        told["evidence"] = evidence(best, 5)
        told["first"] = {"pose": estimate.trajectory[0, :3, 3]}
    if estimate.refinement is not None:
        told["refined"] = [estimate.refinement.accepted, {"pose": estimate.refinement.coarse.pose}]
    return told


def scene_estimate(estimate, most=4):
    """A `SceneEstimate`: verdict, scenes, and the chance of being in none of them."""
    modes = [
        {"scene": m.scene, "p": m.probability, "weight": m.score} for m in estimate.modes[:most]
    ]
    return {"status": estimate.status.name, "modes": modes, "p": estimate.elsewhere}


def changes(diff):
    """A `SceneDiff`."""
    told = [
        {
            "kind": c.kind,
            "label": [c.label, c.id, c.new_label],
            "p": c.confidence,
            "pose": [c.shift_m, *(np.zeros(0) if c.box is None else c.box.ravel())],
        }
        for c in diff.changes
    ]
    return {"changes": told, "same": fingerprint(diff.same), "unseen": fingerprint(diff.unseen)}
