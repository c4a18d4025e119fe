"""GOTLoc's pipeline in plain NumPy, from the paper's text (Eq. 1-19).

Slow, in double precision, one graph and one pair at a time, and its code is its own: nothing here comes
from placegraph, whose pipeline is compared with it. Where the text is open, it is our reading, as
`docs/faithful.md` says, and both share it: the layers of the graph transformer, its pooling, the inverse
of a stated direction, and the signs of both losses.
"""

import re
from math import exp, hypot, log, sqrt

import numpy as np

OPPOSITE = {"north": "south", "south": "north", "east": "west", "west": "east"}
WINDS = ("north", "south", "east", "west")
SENTENCE = re.compile(r"The (.+?) is on the (north|south|east|west) of the (.+?)\.")
CANDIDATES = 10  # Sec. IV-D, n of Eq. 12


def relation(here, there):
    """r of Eq. 6: how `there` lies, seen from `here`; both (2,) east, north."""
    dx, dy = there[0] - here[0], there[1] - here[1]  # Eq. 5
    if abs(dx) <= abs(dy) and dy > 0:
        return "north"
    if abs(dx) <= abs(dy) and dy < 0:
        return "south"
    return "east" if dx > 0 else "west"


def map_graph(labels, points, threshold):
    """Eq. 7: labels, and edges {(source, relation, target)} between objects below a distance."""
    edges = set()
    for i, here in enumerate(points):
        for j, there in enumerate(points):
            if 0 < hypot(there[0] - here[0], there[1] - here[1]) <= threshold:
                edges.add((j, relation(here, there), i))
    return list(labels), edges


def text_graph(text):
    """Eq. 3-4: labels, and edges of sentences "The X is on the north of the Y.", each with its inverse."""
    labels, edges = [], set()
    for source, wind, target in SENTENCE.findall(text):
        for label in (source, target):
            if label not in labels:
                labels.append(label)
        i, j = labels.index(source), labels.index(target)
        edges |= {(i, wind, j), (j, OPPOSITE[wind], i)}
    return labels, edges


class JointNetwork:
    """Encoder, joint model and perceptron with given weights; `vector` gives that of a label."""

    def __init__(self, weights, vector, *, layers, crossings, heads):
        self.weights = {name: np.asarray(w, np.float64) for name, w in weights.items()}
        self.vector, self.layers, self.crossings, self.heads = vector, layers, crossings, heads

    def linear(self, name, x):
        y = np.asarray(x) @ self.weights[f"{name}.weight"].T
        return y + self.weights.get(f"{name}.bias", 0.0)

    def norm(self, name, x):
        out = np.empty_like(x)
        for i, row in enumerate(x):
            unit = (row - row.mean()) / sqrt(row.var() + 1e-5)
            out[i] = unit * self.weights[f"{name}.weight"] + self.weights[f"{name}.bias"]
        return out

    def feed(self, name, x):
        hidden = np.maximum(self.linear(f"{name}.up", x), 0.0)
        return self.norm(f"{name}.norm", x + self.linear(f"{name}.down", hidden))

    def attend(self, queries, keys, values):
        """Softmax attention of each query to all keys, a head at a time."""
        size = queries.shape[1] // self.heads
        out = np.zeros((len(queries), values.shape[1]))
        for h in range(self.heads):
            part = slice(h * size, (h + 1) * size)
            for i, q in enumerate(queries):
                weights = np.array([exp(q[part] @ k[part] / sqrt(size)) for k in keys])
                out[i, part] = weights @ values[:, part] / weights.sum()
        return out

    def pool(self, x):
        total = sum(row / (1.0 + exp(-self.linear("graph.pool.gate", row)[0])) for row in x)
        return self.linear("graph.pool.out", total / sqrt(len(x)))

    def states(self, graph):
        """States of the nodes of a graph after the layers of the encoder."""
        labels, edges = graph
        x = self.norm("graph.norm", np.array([self.vector(label) for label in labels], np.float64))
        for layer in range(self.layers):
            name = f"graph.layers.{layer}"
            sent = self.linear(f"{name}.message", x)
            heard = np.zeros((len(x), len(WINDS), sent.shape[1]))
            for source, wind, target in edges:
                degree = 1 + sum(i == source and r == wind for i, r, _ in edges)
                heard[source, WINDS.index(wind)] += sent[target] / sqrt(degree)
            along = self.linear(f"{name}.along", heard.reshape(len(x), -1))
            q, k, v = np.split(self.linear(f"{name}.qkv", x), 3, axis=1)
            seen = self.linear(f"{name}.out", self.attend(q, k, v))
            x = self.feed(f"{name}.feed", self.norm(f"{name}.norm", x + along + seen))
        return x

    def embed(self, graph):
        """Eq. 9-10: one function for texts and for places."""
        return self.pool(self.states(graph))

    def join(self, text, place):
        """Eq. 14: embeddings of a text and a place that attend to each other."""
        t, m = self.states(text), self.states(place)
        for layer in range(self.crossings):
            name = f"cross.{layer}"
            q, k = self.linear(f"{name}.query", t), self.linear(f"{name}.key", m)
            of_place, of_text = (
                self.linear(f"{name}.of_place", m),
                self.linear(f"{name}.of_text", t),
            )
            seen = self.linear(f"{name}.out_text", self.attend(q, k, of_place))
            meant = self.linear(f"{name}.out_place", self.attend(k, q, of_text))
            t = self.feed(f"{name}.feed_text", self.norm(f"{name}.norm_text", t + seen))
            m = self.feed(f"{name}.feed_place", self.norm(f"{name}.norm_place", m + meant))
        return self.pool(t), self.pool(m)

    def perceptron(self, e_t, e_m):
        """Log odds of the matching probability, of the concatenated embeddings (Eq. 17)."""
        hidden = np.maximum(self.linear("judge.0", np.concatenate([e_t, e_m])), 0.0)
        return self.linear("judge.2", hidden)[0]


def cosine(a, b):
    """Eq. 11 and 15."""
    return a @ b / (sqrt(a @ a) * sqrt(b @ b))


def retrieve(network, text, places, k, n=CANDIDATES):
    """Eq. 11-16: rows of the k best of the n places nearest by embedding, and their cosines."""
    e_t = network.embed(text)
    near = sorted(range(len(places)), key=lambda i: -cosine(e_t, network.embed(places[i])))[:n]
    scores = {i: cosine(*network.join(text, places[i])) for i in near}
    best = sorted(near, key=lambda i: -scores[i])[:k]
    return best, [scores[i] for i in best]


def losses(network, texts, places, right):
    """Eq. 17-18 over all pairs; `right` are pairs (text, place) that belong together; Eq. 19 is the sum."""
    matching, of_right, of_wrong = [], [], []
    for i, text in enumerate(texts):
        for j, place in enumerate(places):
            joint = network.join(text, place)
            probability = 1.0 / (1.0 + exp(-network.perceptron(*joint)))
            matching.append(-log(probability if (i, j) in right else 1.0 - probability))
            (of_right if (i, j) in right else of_wrong).append(cosine(*joint))
    return float(np.mean(matching)), float(np.mean(of_wrong) + np.mean(1.0 - np.array(of_right)))
