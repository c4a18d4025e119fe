"""How the network of SceneGraphLoc is trained, and who is told how far it is."""

from __future__ import annotations

from dataclasses import dataclass

from placegraph.errors import OptionError


@dataclass(frozen=True)
class TrainOptions:
    """How to train; the defaults are the published ones.

    Raises
    ------
    OptionError
        A number is out of its range.

    """

    epochs: int = 30
    batch: int = 16
    """Pictures a step."""
    pictures: int = 0
    """Pictures an epoch, drawn anew in each; 0: all."""
    others: int = 9
    """Other rooms whose objects a patch is told from."""
    points: int = 512
    """Of each object, drawn anew in each epoch; the encoder then looks at as many."""
    rate: float = 1.1e-3
    weight_decay: float = 1e-6
    decay: float = 0.97
    """Of the rate, each epoch."""
    elastic: bool = True
    """Whether points are distorted (`elastic`)."""
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("epochs", 1), ("batch", 1), ("pictures", 0), ("others", 0),
                            ("points", 1), ("seed", 0)):  # fmt: skip
            if getattr(self, name) < least:
                raise OptionError(f"{name} is {getattr(self, name)}; choose at least {least}.")
        if not (0.0 < self.rate <= 1.0 and self.weight_decay >= 0.0 and 0.0 < self.decay <= 1.0):
            raise OptionError(
                f"rate is {self.rate}, weight_decay {self.weight_decay}, decay {self.decay}; rate and "
                "decay are above 0 and at most 1, weight_decay is not negative."
            )


class Progress:
    """Is told how far a training is; override what is of interest."""

    def preparing(self, name: str, done: int, total: int) -> None:
        """A place was looked at."""

    def step(self, epoch: int, done: int, total: int, loss: float) -> None:
        """A batch was learned; `loss` is the mean of the epoch so far."""

    def epoch(self, row: dict[str, float]) -> None:
        """An epoch ended with these figures."""
