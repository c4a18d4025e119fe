"""How the matching network is trained, and who is told how far it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

from placegraph.errors import OptionError
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.network.weights import Shape

LOSSES = ("match", "similarity", "embedding", "fusion")
PRINTED = ("eq17", "eq18")
"""Losses (`objective`): those that teach, and the paper's as printed (Eq. 17-18)."""


@dataclass(frozen=True)
class TrainOptions:
    """How to train."""

    epochs: int = 5
    examples: int = 1200
    """New descriptions a city and epoch; those of earlier epochs are learned again as well."""
    steps: int = 300
    """Batches an epoch."""
    batch: int = 32
    """Descriptions a batch."""
    share: float = 0.4
    """Share of a description's candidates that a batch looks at."""
    rate: float = 2e-3
    """Largest learning rate; a cosine leads to nearly nothing."""
    decay: float = 1e-3
    losses: tuple[str, ...] = LOSSES
    """Which are added up (`objective`); ``eq17`` and ``eq18`` are the paper's as printed."""
    seed: int = 0
    descriptions: int | None = None
    """Seed of the descriptions, so that trainings of several seeds may share them; `seed` where not
    given."""
    check: int = 500
    """Descriptions a city, from tiles not trained on, for the curves and the last two weights."""
    shape: Shape = field(default_factory=Shape)
    word_vectors: str | None = None
    """File of word2vec, text or binary: its vectors stand for the words it knows, as in the paper."""


@dataclass
class Progress:
    """Is told how far a training is; override what is of interest."""

    def filling(self, epoch: int, city: str, done: int, total: int) -> None:
        """Descriptions are made."""

    def step(self, epoch: int, done: int, total: int, losses: Mapping[str, float]) -> None:
        """A batch was learned."""

    def epoch(self, row: Mapping[str, float]) -> None:
        """An epoch ended with these figures."""


def check(cities: Mapping[str, CityMap], options: TrainOptions) -> None:
    """Refuse what cannot be trained: no city, a number out of its range, an unknown loss."""
    if not cities:
        raise OptionError("There is no city to train on; name at least one map.")
    for name in ("epochs", "examples", "steps", "batch", "check"):
        if getattr(options, name) < 1:
            raise OptionError(f"{name} is {getattr(options, name)}; choose at least 1.")
    if not 0.0 < options.rate <= 1.0 or not 0.0 < options.share <= 1.0:
        raise OptionError(
            f"rate is {options.rate}, share {options.share}; choose above 0 and at most 1."
        )
    known = (*LOSSES, *PRINTED)
    if not set(options.losses) <= set(known) or not options.losses:
        raise OptionError(f"losses are {options.losses}; choose among {', '.join(known)}.")
    try:
        Shape.from_dict(asdict(options.shape))
    except ValueError as error:
        raise OptionError(f"There is no network of these {error}.") from error
