"""Packs depth by RVL as compressed_depth_image_transport and RTAB-Map do (rvl_codec.cpp)."""

import struct


def rvl(image):
    """Width, height and the stream of an image (h, w) uint16."""
    values, previous = [], 0
    flat = image.ravel().tolist()
    at = 0
    while at < len(flat):
        start = at
        while at < len(flat) and flat[at] == 0:
            at += 1
        values.append(at - start)
        start = at
        while at < len(flat) and flat[at] != 0:
            at += 1
        values.append(at - start)
        for current in flat[start:at]:
            delta = current - previous
            values.append((delta << 1) ^ (delta >> 31))
            previous = current
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
