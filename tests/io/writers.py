"""Writers of small files: PLY meshes, depth packed by RVL."""

import struct
from itertools import groupby

CODES = {
    "float": "f", "double": "d", "uchar": "B", "int": "i", "uint": "I", "short": "h", "ushort": "H",
}  # fmt: skip


def ply(form, *elements):
    """Bytes of a file; an element is a name, its properties as {name: type} and its rows.

    A type such as "uchar int" makes a list.
    """
    lines = ["ply", f"format {form} 1.0", "comment made by hand"]
    body = []
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    for name, properties, rows in elements:
        lines.append(f"element {name} {len(rows)}")
        for key, kind in properties.items():
            lines.append(f"property {'list ' if ' ' in kind else ''}{kind} {key}")
        for row in rows:
            values = []
            for kind, value in zip(properties.values(), row, strict=True):
                if " " in kind:
                    length, entry = kind.split()
                    values += [(length, len(value)), *((entry, v) for v in value)]
                else:
                    values.append((kind, value))
            kinds, numbers = zip(*values, strict=True)
            if order:
                body.append(struct.pack(order + "".join(CODES[k] for k in kinds), *numbers))
            else:
                body.append(" ".join(map(str, numbers)).encode() + b"\n")
    return "\n".join([*lines, "end_header"]).encode() + b"\n" + b"".join(body)


def rvl(image):
    """Return width, height and the stream of an image (h, w) uint16, as `rvl_codec.cpp` packs depth."""
    values, previous, filled = [], 0, True
    for filled, group in groupby(image.ravel().tolist(), bool):
        run = list(group)
        values += [len(run)] if values or not filled else [0, len(run)]  # zeros come first
        for current in run if filled else ():
            delta = current - previous
            values.append((delta << 1) ^ (delta >> 31))
            previous = current
    values += [] if filled else [0]
    nibbles = []
    for value in values:
        left = value
        while left > 7:
            nibbles.append(left & 7 | 8)
            left >>= 3
        nibbles.append(left)
    nibbles += [0] * (-len(nibbles) % 8)
    words = [
        int("".join(f"{n:x}" for n in nibbles[i : i + 8]), 16) for i in range(0, len(nibbles), 8)
    ]
    return struct.pack(f"<II{len(words)}I", image.shape[1], image.shape[0], *words)
