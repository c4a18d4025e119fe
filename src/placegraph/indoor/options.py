"""Options of indoor localization: plain structs with units; defaults are what measured best."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, Self

import numpy as np

from placegraph.errors import OptionError


def check_numbers(owner: object) -> None:
    """Raise where a number of an options struct is not finite, or negative."""
    for entry in fields(owner):  # type: ignore[arg-type]
        value = getattr(owner, entry.name)
        if isinstance(value, float | int) and not (np.isfinite(value) and value >= 0):
            raise OptionError(f"{entry.name} is {value}; it must be a number, not below 0.")


def check_whole(owner: object, *names: str) -> None:
    """Raise where one of these numbers of an options struct is not 1, 2, 3, ..."""
    for name in names:
        value = getattr(owner, name)
        if int(value) != value or value < 1:
            raise OptionError(f"{name} is {value}; it must be a whole number from 1 on.")


def check_positive(owner: object, *names: str) -> None:
    """Raise where one of these numbers of an options struct is not greater than 0."""
    for name in names:
        value = getattr(owner, name)
        if not (np.isfinite(value) and value > 0):
            raise OptionError(f"{name} is {value}; it must be greater than 0.")


def check_device(device: str, *, network: bool = False) -> None:
    """Raise where a device is not the CPU; a matcher that is a `network` may run on CUDA."""
    if device.startswith("cuda") and not network:
        raise OptionError(f"device is {device!r}; only matchers that are networks run there.")
    if device not in {"auto", "cpu"} and not device.startswith("cuda"):
        raise OptionError(f"device is {device!r}; it is 'auto', 'cpu' or 'cuda'.")


@dataclass(frozen=True, slots=True)
class MotionNoise:
    """Gaussian noise of Eq. 1, per frame: a floor, and a share of the way and of the turn."""

    translation: float = 0.01
    """[m] (the paper: 0.05)"""
    translation_per_metre: float = 0.03
    rotation: float = 0.005
    """Yaw [rad] (the paper: 0.05)."""
    rotation_per_radian: float = 0.02

    def __post_init__(self) -> None:
        check_numbers(self)


@dataclass(frozen=True, slots=True)
class Likelihood:
    """How what a frame shows becomes a log-likelihood; `docs/indoor.md` derives each part.

    ``calibrated`` takes every patch, reading and sample for a witness that may err, and counts
    witnesses that see the same thing only in part. ``gaussian`` is the paper's Eq. 2.
    """

    kind: Literal["calibrated", "gaussian"] = "calibrated"
    wrong: float = 0.3
    """Share of patches taken to be labelled wrongly."""
    sharpness: float = 0.0
    """Temperature of the softmax that turns cosine similarities into probabilities; 0: the
    encoder's own."""
    object_patches: float = 40.0
    """An object seen in more patches than this speaks with the square root of the surplus only:
    its patches are right or wrong together."""
    depth_floor: float = 0.05
    """Standard deviation of depth [m] at 0 m, map included ..."""
    depth_slope: float = 0.03
    """... and what it gains a metre."""
    depth_gain: float = 3.5
    """Log-likelihood of a perfect reading over one from anywhere [nat]."""
    near_cost: float = 1.5
    """Log-likelihood lost where something stands before the map's surface [nat]."""
    far_cost: float = 2.0
    """Log-likelihood lost where the map's surface is not there [nat]."""
    depth_weight: float = 60.0
    """Independent readings in a full depth image."""
    colour_weight: float = 360.0
    """Independent samples in a full colour image, by steps of colour between neighbours ..."""
    tone_weight: float = 180.0
    """... and by the colours themselves, which count beside depth only: without it, light and large
    areas would decide."""
    sigma: float = 0.2
    """Of Eq. 2 (``gaussian`` only)."""
    depth_clip: float = 0.5
    """Largest error of one reading [m] (``gaussian`` only); 0: none, as printed in Sec. 3.4."""
    depth_lambda: float = 1.0
    """lambda_1 of Eq. 2."""
    colour_lambda: float = 1.0
    """lambda_2 of Eq. 2."""

    def __post_init__(self) -> None:
        if self.kind not in {"calibrated", "gaussian"}:
            raise OptionError(f"kind is {self.kind!r}; it is 'calibrated' or 'gaussian'.")
        if not 0 < self.wrong < 1:
            raise OptionError(f"wrong is {self.wrong}; a share lies between 0 and 1.")
        check_numbers(self)
        check_positive(self, "object_patches", "depth_floor", "sigma")

    @property
    def tempered(self) -> bool:
        """Whether a filter may flatten it; Eq. 2 is taken at its word."""
        return self.kind == "calibrated"


@dataclass(frozen=True, slots=True)
class Pass:
    """One pass of the filter over the sequence (Sec. 3.5)."""

    stride: float
    """Pixels of the colour image between samples."""
    box: float
    """Edge of the box around each mode in which particles are spread [m]; 0: the whole map."""
    turn: float
    """Half width in yaw of that box [rad]."""
    particles: int
    """Most particles drawn for the pass and after a resampling."""

    def __post_init__(self) -> None:
        check_numbers(self)
        check_positive(self, "stride")
        check_whole(self, "particles")


ONE_PASS = (Pass(stride=20.0, box=0.0, turn=np.pi, particles=300),)
"""What the benchmark left of the passes."""
COARSE_TO_FINE = (
    Pass(stride=20.0, box=0.0, turn=np.pi, particles=600),
    Pass(stride=8.0, box=0.8, turn=0.3, particles=160),
    Pass(stride=4.0, box=0.4, turn=0.1, particles=60),
)
"""The strides of the paper's three passes, from the table, with tighter boxes."""
_PRINTED = 2500  # particles on 3RScan (Sec. 5)


def _passes(first: float, second: float, third: float) -> tuple[Pass, ...]:
    """The paper's three passes at these strides (Sec. 3.5)."""
    return (
        Pass(stride=first, box=0.0, turn=np.pi, particles=10 * _PRINTED),
        Pass(stride=second, box=1.6, turn=np.pi / 4, particles=_PRINTED),
        Pass(stride=third, box=0.8, turn=np.pi / 8, particles=_PRINTED),
    )


STANDING = (1.5, 1.6, 1.7, 1.8)
"""Heights at which people look, and hold a camera [m]: those of the paper's start."""


@dataclass(frozen=True, slots=True)
class PoseSearchOptions:
    """Options of the search of poses: what is compared, where, and by which likelihood.

    Seeds come from the visibility table, and are fitted to and weighed by the whole sequence.
    """

    semantic: bool = True
    """Use the encoder's patches, where there are any."""
    depth: bool = True
    """Use depth images, where there are any."""
    colour: bool = True
    """Use the colour images, where the map has colours."""
    heights: tuple[float, ...] = (0.15, 2.3)
    """Heights of the camera above the floor [m]: the table spans them, a uniform start has
    each, and those of `STANDING` between them."""
    spacing: float = 0.5
    """Grid of the visibility table; of uniform particles the paper's 0.2 [m]."""
    motion: MotionNoise = field(default_factory=MotionNoise)
    likelihood: Likelihood = field(default_factory=Likelihood)
    modes: int = 8
    """Most modes kept between passes, and answered."""
    every: float = 0.0
    """Keyframes: least time between frames used [s]; 0: all frames."""
    every_metre: float = 0.0
    """Keyframes: least way between frames used [m], or 0.2 rad of turn; 0: all frames."""

    def __post_init__(self) -> None:
        if not (self.semantic or self.depth or self.colour):
            raise OptionError("semantic, depth and colour are all off; leave one on.")
        object.__setattr__(self, "heights", tuple(float(h) for h in self.heights))
        if not self.heights or not all(np.isfinite(self.heights)):
            raise OptionError("heights: give at least one height of the camera above the floor.")
        check_numbers(self)
        check_whole(self, "modes")
        check_positive(self, "spacing")
        if not (self.every >= 0 and self.every_metre >= 0):
            raise OptionError("every, every_metre: a time and a way, not less than 0.")

    @property
    def particle_filter(self) -> FilterOptions | None:
        """The particle filter that runs between the search and the fit; None: there is none."""
        return None

    @property
    def tracked(self) -> bool:
        """Whether a tracker can follow it: one starts from the table, and fits."""
        return True

    def with_filter(self, **changes: Any) -> FilterOptions:  # noqa: ANN401
        """Return the same with a particle filter; `changes`: fields of `FilterOptions`."""
        known = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return FilterOptions(**known | changes)

    def only(self, *, semantic: bool = False, depth: bool = False, colour: bool = False) -> Self:
        """The same with only the terms named."""
        return replace(self, semantic=semantic, depth=depth, colour=colour)


@dataclass(frozen=True, slots=True)
class FilterOptions(PoseSearchOptions):
    """Options of the particle filter (SG2Loc, Sec. 3), which runs between the search and the fit.

    `PoseSearchOptions` alone do without: fits do as well from the seeds of the search.
    """

    start: Literal["table", "uniform"] = "table"
    """First particles: where the visibility table says the frames could be, or everywhere."""
    per_cell: int = 3
    """Particles a cell and height of a uniform start."""
    passes: tuple[Pass, ...] = ONE_PASS
    """Passes over the sequence, coarse to fine."""
    kld: bool = True
    """Let KLD-sampling decide how many particles are drawn; else as many as before."""
    kld_error: float = 0.1
    """epsilon of KLD-sampling."""
    kld_confidence: float = 0.95
    """1 - delta of KLD-sampling."""
    min_particles: int = 24
    """Fewest particles that KLD-sampling leaves, as far as the pass has so many."""
    injection: float = 0.1
    """Share of particles drawn anew: from the table, or of a uniform start from everywhere."""
    inject_every: int = 0
    """Frames between injections; 0: where the likelihood drops."""
    unscored: int = 0
    """Frames at the beginning that only move particles; the last is always scored."""
    pool_modes: bool = False
    """Modes between passes are those of all frames of a pass; else of its last frame."""
    answer: Literal["fit", "mle"] = "fit"
    """The best modes, fitted to and weighed by the whole sequence; or the heaviest particles of the
    last pass as they are, the first of which is the maximum likelihood estimate of Sec. 3.5."""
    record: bool = False
    """Keep all particles of all passes in the estimate, for pictures."""

    def __post_init__(self) -> None:
        PoseSearchOptions.__post_init__(self)
        if self.start not in {"table", "uniform"}:
            raise OptionError(f"start is {self.start!r}; it is 'table' or 'uniform'.")
        if self.answer not in {"fit", "mle"}:
            raise OptionError(f"answer is {self.answer!r}; it is 'fit' or 'mle'.")
        if not self.passes:
            raise OptionError("passes: give one at least, or PoseSearchOptions to do without.")
        check_whole(self, "per_cell", "min_particles")
        check_positive(self, "kld_error")
        if not 0 < self.kld_confidence < 1 or not 0 <= self.injection < 1:
            raise OptionError("kld_confidence and injection are shares between 0 and 1.")

    @property
    def particle_filter(self) -> FilterOptions | None:
        """The filter itself."""
        return self

    @property
    def tracked(self) -> bool:
        """Whether a tracker can follow it: one starts from the table, and fits."""
        return self.start == "table" and self.answer == "fit"

    @staticmethod
    def preset(name: str) -> PoseSearchOptions:
        """Return the recipe of that name: ``default``, ``paper``, ``published`` or ``coarse``."""
        presets: dict[str, Callable[[], PoseSearchOptions]] = {
            "default": PoseSearchOptions, "paper": FilterOptions.paper,
            "published": FilterOptions.published, "coarse": FilterOptions.coarse,
        }  # fmt: skip
        if name not in presets:
            raise OptionError(f"preset is {name!r}; there are {', '.join(presets)}.")
        return presets[name]()

    @classmethod
    def paper(cls) -> FilterOptions:
        """The paper's recipe as printed (Sec. 3.1-3.5).

        Uniform start, Eq. 2, strides 20/8/4 in boxes of 1.6 and 0.8 m around one MLE, about 2,500
        particles (Sec. 5), no table, no injection, no fit. As these are the fewest, and all that
        passes 2 and 3 draw, KLD-sampling adapts pass 1 alone. The first particle of a box is the MLE
        itself. Where the paper gives no number: yaws within 45 and 22.5 degrees of the MLE, halved
        as the boxes are; 0.1 and 0.95 for KLD.
        """
        return cls(
            heights=STANDING,
            start="uniform",
            spacing=0.2,
            passes=_passes(20.0, 8.0, 4.0),
            motion=MotionNoise(0.05, 0.0, 0.05, 0.0),
            likelihood=Likelihood(kind="gaussian", sigma=0.2, depth_clip=0.0),
            min_particles=_PRINTED,
            injection=0.0,
            modes=1,
            answer="mle",
        )

    @classmethod
    def published(cls) -> FilterOptions:
        """The paper's recipe with what the published code does otherwise, but without its faults.

        `docs/indoor.md` lists both; boxes and numbers of particles are the paper's.
        """
        return replace(
            cls.paper(),
            spacing=0.1,
            per_cell=4,
            passes=_passes(20.0, 12.0, 20.0),
            likelihood=Likelihood(kind="gaussian", sigma=0.6, depth_clip=0.5),
            injection=0.1,
            inject_every=5,
            unscored=1,
            modes=8,
            pool_modes=True,
        )

    @classmethod
    def coarse(cls) -> FilterOptions:
        """The paper's recipe with its pass of stride 20 alone (App. E)."""
        paper = cls.paper()
        return replace(paper, passes=paper.passes[:1])
