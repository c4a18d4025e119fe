"""Kernels of the OpenStreetMap reader: protocol buffers, positions of nodes by id, lines of ways."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel

# mypy: allow-untyped-defs, allow-incomplete-defs


VARINT, EIGHT, BYTES, FOUR = 0, 1, 2, 5
"""Wire types of a field in protocol buffers."""


@kernel(inline=True)
def decode_varint(data, at, end):
    """Return an integer of up to 64 bits and the next position; -1 where it is cut off or longer."""
    value, shift = np.int64(0), np.int64(0)
    while at < end and shift < 70:
        byte = np.int64(data[at])
        at += 1
        if shift < 64:
            value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
    return value, np.int64(-1)


@kernel(inline=True)
def decode_zigzag(value):
    """Decode a zigzag number, whose sign is its lowest bit."""
    return ((value >> 1) & 0x7FFFFFFFFFFFFFFF) ^ -(value & 1)


@kernel
def read_field(data, at, end):
    """Return the next field: number, value or length in bytes, its position and the next one.

    The last is -1 where it reaches beyond the end; numbers of plain values are negative.
    """
    key, at = decode_varint(data, at, end)
    wire, number, value = key & 7, key >> 3, np.int64(0)
    if at < 0 or number < 1:
        return number, value, at, np.int64(-1)
    if wire == VARINT:
        value, after = decode_varint(data, at, end)
        return -number, value, at, after
    if wire == BYTES:
        value, at = decode_varint(data, at, end)
    elif wire in (EIGHT, FOUR):
        number, value = np.int64(1) << 40, np.int64(8 if wire == EIGHT else 4)  # nothing of ours
    else:
        return number, value, at, np.int64(-1)
    if at < 0 or value < 0 or value > end - at:
        return number, value, at, np.int64(-1)
    return number, value, at, at + value


@kernel
def read_fields(data, at, end):
    """Return all fields of a message (F, 3): number (negative: a value), value or length, position.

    And whether the message is sound.
    """
    found, n = np.empty((16, 3), np.int64), 0
    while at < end:
        number, value, begins, at = read_field(data, at, end)
        if at < 0:
            return found[:0], False
        if n == len(found):
            found = np.concatenate((found, np.empty_like(found)))
        found[n, 0], found[n, 1], found[n, 2] = number, value, begins
        n += 1
    return found[:n], True


@kernel(inline=True)
def read_numbers(data, number, value, at, out, used):
    """Append a field's numbers, packed or single, to the `used` ones; return the new count, or -1."""
    if number < 0:
        out[used] = value
        return used + 1
    end = at + value
    while at < end:
        out[used], at = decode_varint(data, at, end)
        if at < 0:
            return -1
        used += 1
    return used


@kernel(inline=True)
def read_version(data, at, end):
    """Return the version in an element's `Info`; -1 where it is damaged."""
    found = np.int64(0)
    while at < end:
        number, value, _, at = read_field(data, at, end)
        if at < 0 or (number == -1 and value < 0):
            return np.int64(-1)
        if number == -1:
            found = value
    return found


@kernel
def read_dense_nodes(data, at, end):
    """Read dense nodes: ids, versions, latitudes, longitudes, raw tags, and whether all is valid.

    Ids and positions are differences no more.
    """
    room = end - at
    ids, lat, lon = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room, np.int64)
    tags, versions = np.empty(room, np.int64), np.empty(room, np.int64)
    n = n_lat = n_lon = n_tags = n_versions = 0
    while at < end:
        number, value, begins, at = read_field(data, at, end)
        if at < 0:
            n = -1
        elif abs(number) == 1:
            n = read_numbers(data, number, value, begins, ids, n)
        elif abs(number) == 8:
            n_lat = read_numbers(data, number, value, begins, lat, n_lat)
        elif abs(number) == 9:
            n_lon = read_numbers(data, number, value, begins, lon, n_lon)
        elif abs(number) == 10:
            n_tags = read_numbers(data, number, value, begins, tags, n_tags)
        elif number == 5:
            within, stop = begins, begins + value
            while within < stop and n_versions >= 0:
                inner, size, begins, within = read_field(data, within, stop)
                if within < 0:
                    n_versions, within = -1, stop
                elif abs(inner) == 1:
                    n_versions = read_numbers(data, inner, size, begins, versions, n_versions)
        if min(n, n_lat, n_lon, n_tags, n_versions) < 0:
            return ids[:0], ids[:0], lat[:0], lon[:0], tags[:0], False
    good = n == n_lat == n_lon and (n_versions == n or n_versions == 0)
    if n_versions == 0:
        versions[:n] = 0
    identity = y = x = np.int64(0)
    for i in range(n if good else 0):
        identity += decode_zigzag(ids[i])
        y += decode_zigzag(lat[i])
        x += decode_zigzag(lon[i])
        ids[i], lat[i], lon[i] = identity, y, x
    return ids[:n], versions[:n], lat[:n_lat], lon[:n_lon], tags[:n_tags], good


@kernel
def read_dense_tags(tags, nodes, n_strings):
    """Return tags of dense nodes as CSR: offsets, alternating keys and values, and whether they are valid."""
    starts, pairs, used, row = np.zeros(nodes + 1, np.int64), np.empty(len(tags), np.int64), 0, 0
    at = 0
    while at < len(tags):
        if tags[at] == 0:
            row += 1
            if row > nodes:
                return starts, pairs[:0], False
            starts[row] = used
            at += 1
            continue
        if at + 1 == len(tags) or row == nodes:
            return starts, pairs[:0], False
        key, value = tags[at], tags[at + 1]
        if not (0 < key < n_strings and 0 <= value < n_strings):
            return starts, pairs[:0], False
        pairs[used], pairs[used + 1] = key, value
        used += 2
        at += 2
    return starts, pairs[:used], row == nodes or len(tags) == 0


@kernel
def read_elements(data, groups, wanted, n_strings):
    """Read nodes, ways or relations, one message each, from groups (G, 2) of byte ranges.

    `wanted` is the field of a group that holds them. Returns, a row each: id as it is written, version,
    where its message begins and how long it is; then starts and entries of its tags (keys and values by
    turns) and of its fields 8, 9 and 10; and whether all is sound.
    """
    room = 0
    for g in range(len(groups)):
        room += groups[g, 1] - groups[g, 0]
    head, n = np.empty((256, 4), np.int64), 0
    starts = np.zeros((256, 4), np.int64)
    entries = np.empty((4, room), np.int64)
    keys, values = np.empty(room, np.int64), np.empty(room, np.int64)
    used = np.zeros(4, np.int64)
    for g in range(len(groups)):
        at, end = groups[g]
        while at < end:
            number, size, within, at = read_field(data, at, end)
            if at < 0:
                return head[:0], starts[:1], entries, False
            if number != wanted:
                continue
            if n + 2 > len(head):
                head = np.concatenate((head, np.empty_like(head)))
                starts = np.concatenate((starts, np.zeros_like(starts)))
            head[n, 0], head[n, 1], head[n, 2], head[n, 3] = 0, 0, within, size
            n_keys = n_values = 0
            stop, named = within + size, False
            while within < stop:
                inner, value, begins, within = read_field(data, within, stop)
                if within < 0:
                    return head[:0], starts[:1], entries, False
                if inner == -1:
                    head[n, 0], named = value, True
                elif abs(inner) == 2:
                    n_keys = read_numbers(data, inner, value, begins, keys, n_keys)
                elif abs(inner) == 3:
                    n_values = read_numbers(data, inner, value, begins, values, n_values)
                elif inner == 4:
                    head[n, 1] = read_version(data, begins, begins + value)
                elif 8 <= abs(inner) <= 10:
                    k = abs(inner) - 7
                    used[k] = read_numbers(data, inner, value, begins, entries[k], used[k])
                if min(n_keys, n_values, head[n, 1], used.min()) < 0:
                    return head[:0], starts[:1], entries, False
            if not named or n_keys != n_values:
                return head[:0], starts[:1], entries, False
            for i in range(n_keys):
                if not (0 <= keys[i] < n_strings and 0 <= values[i] < n_strings):
                    return head[:0], starts[:1], entries, False
                entries[0, used[0]], entries[0, used[0] + 1] = keys[i], values[i]
                used[0] += 2
            n += 1
            for k in range(4):
                starts[n, k] = used[k]
    return head[:n], starts[: n + 1], entries, True


@kernel
def decode_zigzags(values):
    """Decode zigzag numbers, whose signs are their lowest bits."""
    out = np.empty(len(values), np.int64)
    for i in range(len(values)):
        out[i] = decode_zigzag(values[i])
    return out


@kernel
def decode_differences(starts, values):
    """Decode zigzag differences within each row of a CSR."""
    out = np.empty(len(values), np.int64)
    for row in range(len(starts) - 1):
        total = np.int64(0)
        for i in range(starts[row], starts[row + 1]):
            total += decode_zigzag(values[i])
            out[i] = total
    return out


@kernel
def encode_varints(values):
    """Encode integers as varints, one after the other."""
    out, at = np.empty(10 * len(values), np.uint8), 0
    for i in range(len(values)):
        value = values[i]
        while value < 0 or value > 0x7F:
            out[at] = (value & 0x7F) | 0x80
            value = (value >> 7) & 0x01FFFFFFFFFFFFFF
            at += 1
        out[at] = value
        at += 1
    return out[:at]


# mypy: allow-untyped-defs, allow-incomplete-defs


@kernel
def look_up_nodes(first, bounds, words, ids):
    """Look up positions (K, 2) of nodes by id, and which are known; `Nodes` explains `words`.

    What is looked for often stands behind what was found last.
    """
    steps, known = np.zeros((len(ids), 2), np.int32), np.zeros(len(ids), np.bool_)
    chunk, at = 0, np.int64(-1)
    for k in range(len(ids) if len(first) else 0):
        if ids[k] < first[chunk] or (chunk + 1 < len(first) and ids[k] >= first[chunk + 1]):
            chunk, high = 0, len(first)
            while high - chunk > 1:
                middle = (chunk + high) >> 1
                if first[middle] <= ids[k]:
                    chunk = middle
                else:
                    high = middle
            at = np.int64(-1)
        begins, size = 3 * bounds[chunk], bounds[chunk + 1] - bounds[chunk]
        wanted = ids[k] - first[chunk]
        at += 1
        if at >= size or np.int64(words[begins + at]) & 0xFFFFFFFF != wanted:
            at, high = np.int64(0), size
            while high > at:
                middle = (at + high) >> 1
                if np.int64(words[begins + middle]) & 0xFFFFFFFF < wanted:
                    at = middle + 1
                else:
                    high = middle
            if at == size or np.int64(words[begins + at]) & 0xFFFFFFFF != wanted:
                continue
        known[k] = True
        steps[k, 0], steps[k, 1] = words[begins + size + 2 * at], words[begins + size + 2 * at + 1]
    return steps, known


@kernel
def sample_ids(first, bounds, words, every):
    """Return the first id of each chunk, and one of every `every` others."""
    found, n = np.empty(len(first) + bounds[-1] // every, np.int64), 0
    for chunk in range(len(first)):
        for at in range(0, bounds[chunk + 1] - bounds[chunk], every):
            found[n] = first[chunk] + (np.int64(words[3 * bounds[chunk] + at]) & 0xFFFFFFFF)
            n += 1
    return found[:n]


@kernel
def nodes_between(first, bounds, words, low, high):
    """Return ids and positions of all nodes with ids from `low` to below `high`."""
    ends, n = np.zeros((len(first), 2), np.int64), 0
    for chunk in range(len(first)):
        for side in range(2):
            wanted, at, end = (low, high)[side] - first[chunk], 0, bounds[chunk + 1] - bounds[chunk]
            while end > at:
                middle = (at + end) >> 1
                if np.int64(words[3 * bounds[chunk] + middle]) & 0xFFFFFFFF < wanted:
                    at = middle + 1
                else:
                    end = middle
            ends[chunk, side] = at
        n += ends[chunk, 1] - ends[chunk, 0]
    ids, steps, n = np.empty(n, np.int64), np.empty((n, 2), np.int32), 0
    for chunk in range(len(first)):
        begins, size = 3 * bounds[chunk], bounds[chunk + 1] - bounds[chunk]
        for at in range(ends[chunk, 0], ends[chunk, 1]):
            ids[n] = first[chunk] + (np.int64(words[begins + at]) & 0xFFFFFFFF)
            steps[n, 0] = words[begins + size + 2 * at]
            steps[n, 1] = words[begins + size + 2 * at + 1]
            n += 1
    return ids, steps


@kernel
def way_points(starts, steps, is_known):
    """Return the points of ways whose nodes have known positions.

    Returns starts and points, and which ways lack some. What is whole has no point twice in a row; where
    one is missing, or all are one, all that are known stand.
    """
    made, points, n = np.zeros(len(starts), np.int64), np.empty_like(steps), 0
    lacks = np.zeros(len(starts) - 1, np.bool_)
    for way in range(len(starts) - 1):
        first = n
        for whole in (True, False):
            n = first
            for i in range(starts[way], starts[way + 1]):
                same = n > first and (points[n - 1] == steps[i]).all()
                if is_known[i] and not (whole and same):
                    points[n] = steps[i]
                    n += 1
                lacks[way] |= not is_known[i]
            lacks[way] |= n - first < 2
            if not lacks[way]:
                break
        made[way + 1] = n
    return made, points[:n], lacks
