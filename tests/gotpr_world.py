"""A tiny GOTPR in the released layout: pickled graphs, and weights of random numbers."""

import pickle

import numpy as np
from tests.kitti360pose_world import made, published

WIDTH, HEADS = 6, 2
WORDS = ("bench", "tree", "bakery", "kiosk", "road", "lamp", "park", "fence")
WINDS = ("north", "south", "east", "west")


def vectors(width=WIDTH):
    rng = np.random.default_rng(7)
    return {word: rng.normal(size=width).astype(np.float32) for word in (*WORDS, *WINDS)}


def graph(module, scene, nodes, edges, known, *, lists=False):
    """A graph of labels by id and (source, wind, target) of ids."""

    def vector(word):
        return known[word].tolist() if lists else known[word]

    things = {
        i: made(
            module.Node,
            idx=i,
            label_features=vector(word),
            attribute_features=[],
            label=word,
            attributes={"all": []},
            features=vector(word) if lists else known[word] + np.zeros(len(known[word])),
            centroid=np.array([1.0 * i, 2.0]),
        )
        for i, word in nodes.items()
    }
    return made(
        module.SceneGraph,
        scene_id=scene,
        nodes=things,
        edge_idx=[[a for a, _, _ in edges], [b for _, _, b in edges]],
        edge_relations=[wind for _, wind, _ in edges],
        edge_features=[vector(wind) for _, wind, _ in edges],
        txt_id=0,
    )


def drawn(rng, n):
    """Labels and edges of n things, their ids not from 0."""
    ids = [int(i) for i in rng.choice(50, n, replace=False)]
    nodes = {i: str(rng.choice(WORDS)) for i in ids}
    pairs = [(a, b) for a in ids for b in ids if a != b and rng.random() < 0.6]
    return nodes, [(a, str(rng.choice(WINDS)), b) for a, b in pairs]


def write_graphs(folder, *, cells=12, lists=False, edit=None):
    """`scene_graphs` of two drives; a text is a part of its cell."""
    rng, known = np.random.default_rng(3), vectors()
    (folder / "scene_graphs").mkdir(parents=True, exist_ok=True)
    with published("scene_graph", ("SceneGraph", "Node")) as module:
        of_cells, texts = {}, {"val": {}, "test": {}}
        for drive, split in (("0010", "val"), ("0003", "test")):
            for k in range(cells):
                name = f"{drive}_{k:05d}"
                nodes, edges = drawn(rng, 6)
                of_cells[name] = graph(module, name, nodes, edges, known, lists=lists)
                some = dict(list(nodes.items())[:5])
                told = [e for e in edges if {e[0], e[2]} <= some.keys()]
                for text in range(2):
                    texts[split][f"{name}_{text:05d}"] = graph(module, name, some, told, known)
        if edit is not None:
            edit(of_cells)
        for name, found in (
            ("osm_cell_graphs", of_cells),
            *((f"osm_{split}_text_graphs", told) for split, told in texts.items()),
        ):
            path = folder / "scene_graphs" / f"{name}_{len(found)}.pkl"
            path.write_bytes(pickle.dumps(found, protocol=4))
    return folder


def state(layers=1, heads=HEADS, width=WIDTH, seed=0):
    """Random numbers by the names and shapes of `BigGNN(N, heads).state_dict()`.

    Written down by hand from PyTorch Geometric's `TransformerConv(width, width, concat=False,
    heads=heads, edge_dim=width)`: key, query and value with bias, edge without, root weight.
    """
    rng = np.random.default_rng(seed)
    shapes = {}
    for layer in range(layers):
        for side in ("TSALayers", "GSALayers", "TCALayers", "GCALayers"):
            at = f"{side}.{layer}.TConv"
            for name in ("lin_key", "lin_query", "lin_value"):
                shapes[f"{at}.{name}.weight"] = (heads * width, width)
                shapes[f"{at}.{name}.bias"] = (heads * width,)
            shapes[f"{at}.lin_edge.weight"] = (heads * width, width)
            shapes[f"{at}.lin_skip.weight"] = (width, width)
            shapes[f"{at}.lin_skip.bias"] = (width,)
    for i, (to, of) in {
        0: (2 * width, 2 * width), 2: (width, 2 * width), 4: (1, width),
    }.items():  # fmt: skip
        shapes[f"SceneText_MLP.{i}.weight"], shapes[f"SceneText_MLP.{i}.bias"] = (to, of), (to,)
    return {n: rng.normal(scale=0.5, size=s).astype(np.float32) for n, s in shapes.items()}
