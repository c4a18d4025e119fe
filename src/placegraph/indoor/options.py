"""Options of indoor localization: plain structs with units; defaults are what measured best."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from math import inf, pi
from typing import Any, Literal, Self

from placegraph.core.options import check_options, option
from placegraph.errors import OptionError

KNOWN = "Prior knowledge"
USED = "Frame data"


def check_device(device: str, *, network: bool = False) -> None:
    """Raise where a device is not the CPU; a matcher that is a `network` may run on CUDA."""
    if device.startswith("cuda") and not network:
        raise OptionError(
            f"device is {device!r}, but this matcher is not a neural network; remove it."
        )
    if device not in {"auto", "cpu"} and not device.startswith("cuda"):
        raise OptionError(f"device is {device!r}; it must be 'auto', 'cpu' or 'cuda'.")


@dataclass(frozen=True, slots=True)
class MotionNoise:
    """Gaussian noise of Eq. 1, per frame: a floor, and a share of the way and of the turn."""

    translation: float = option(
        0.01, "Standard deviation of the translation (paper: 0.05).", unit="m"
    )
    translation_per_metre: float = option(
        0.03, "Increase of this standard deviation per metre travelled."
    )
    rotation: float = option(0.005, "Standard deviation of the yaw (paper: 0.05).", unit="rad")
    rotation_per_radian: float = option(
        0.02, "Increase of this standard deviation per radian turned."
    )

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True, slots=True)
class Likelihood:
    """Log-likelihood of a frame; `docs/indoor.md` derives each part.

    ``calibrated`` takes every patch, reading and sample for a source that may err, and counts those
    that see the same thing only in part. ``gaussian`` is the paper's Eq. 2.
    """

    kind: Literal["calibrated", "gaussian"] = option(
        "calibrated", "`gaussian`: Eq. 2 of the paper."
    )
    wrong: float = option(0.3, "Share of patches with a wrong label.", above=0, below=1)
    sharpness: float = option(
        0.0, "Temperature of the softmax of cosine similarities; 0: the encoder's own."
    )
    object_patches: float = option(
        40.0,
        "Number of patches of one object that count in full; of more, only the square root "
        "of the surplus counts, because their errors are correlated.",
        above=0,
    )
    depth_floor: float = option(
        0.05, "Standard deviation of depth at 0 m, errors of the map included.", unit="m", above=0
    )
    depth_slope: float = option(0.03, "Increase of the standard deviation of depth per metre.")
    depth_gain: float = option(
        3.5, "Log-likelihood ratio of a perfect reading to a random one.", unit="nat"
    )
    near_cost: float = option(
        1.5, "Log-likelihood lost if an object stands in front of the map's surface.", unit="nat"
    )
    far_cost: float = option(
        2.0, "Log-likelihood lost if the map's surface is missing.", unit="nat"
    )
    depth_weight: float = option(60.0, "Independent readings in a full depth image.")
    colour_weight: float = option(
        360.0, "Independent samples of colour steps between neighbours in a full colour image."
    )
    tone_weight: float = option(
        180.0,
        "Independent samples of the colours themselves. They count only beside depth, because light "
        "and large areas would decide otherwise.",
    )
    sigma: float = option(0.2, "Standard deviation in Eq. 2 (`gaussian` only).", above=0)
    depth_clip: float = option(
        0.5,
        "Maximum error of one reading (`gaussian` only); 0: no limit, as in Sec. 3.4.",
        unit="m",
    )
    depth_lambda: float = option(1.0, "lambda_1 of Eq. 2.")
    colour_lambda: float = option(1.0, "lambda_2 of Eq. 2.")

    def __post_init__(self) -> None:
        check_options(self)

    @property
    def tempered(self) -> bool:
        """Whether a filter may flatten it; Eq. 2 is taken at its word."""
        return self.kind == "calibrated"


@dataclass(frozen=True, slots=True)
class Pass:
    """One pass of the filter over the sequence (Sec. 3.5)."""

    stride: float = option(20.0, "Distance of samples in the colour image.", unit="px", above=0)
    box: float = option(
        0.0, "Side length of the box of particles around each mode; 0: the whole map.", unit="m"
    )
    turn: float = option(pi, "Half width of the box of particles in yaw.", unit="rad")
    particles: int = option(
        300, "Maximum number of particles at the start of the pass and after resampling.", minimum=1
    )
    scaled: bool = option(True, "Enlarge the stride in images larger than 640 px (paper: never).")

    def __post_init__(self) -> None:
        check_options(self)


ONE_PASS = (Pass(),)
"""Single level with the default stride and box."""
COARSE_TO_FINE = (
    Pass(stride=20.0, box=0.0, turn=pi, particles=600),
    Pass(stride=8.0, box=0.8, turn=0.3, particles=160),
    Pass(stride=4.0, box=0.4, turn=0.1, particles=60),
)
"""The strides of the paper's three passes, from the table, with tighter boxes."""
_PRINTED = 2500  # particles on 3RScan (Sec. 5)


def _passes(first: float, second: float, third: float) -> tuple[Pass, ...]:
    """The paper's three passes at these strides, whatever the size of images (Sec. 3.5)."""
    return (
        Pass(stride=first, box=0.0, turn=pi, particles=10 * _PRINTED, scaled=False),
        Pass(stride=second, box=1.6, turn=pi / 4, particles=_PRINTED, scaled=False),
        Pass(stride=third, box=0.8, turn=pi / 8, particles=_PRINTED, scaled=False),
    )


STANDING = (1.5, 1.6, 1.7, 1.8)
"""Heights at which people look, and hold a camera [m]: those of the paper's start."""


@dataclass(frozen=True, slots=True)
class PoseSearchOptions:
    """Options of the search of poses: what is compared, where, and by which likelihood.

    Seeds come from the visibility table, and are fitted to and weighed by the whole sequence.
    """

    semantic: bool = option(
        True, "Use the labels of the frames.", flag="--semantic/--no-semantic", panel=USED
    )
    depth: bool = option(True, "Use depth images.", flag="--depth/--no-depth", panel=USED)
    colour: bool = option(
        True, "Use colours where the map has some.", flag="--colour/--no-colour", panel=USED
    )
    heights: tuple[float, ...] = option(
        (0.15, 2.3),
        "Camera heights above the floor. The visibility table spans them; a uniform start "
        "uses each of them and, between two, those of `STANDING`.",
        unit="m",
        minimum=-inf,
        flag="--height",
        panel=KNOWN,
    )
    spacing: float = option(
        0.5,
        "Grid of the visibility table, or of uniform particles (paper: 0.2).",
        unit="m",
        above=0,
    )
    motion: MotionNoise = option(MotionNoise(), "Noise of the odometry.")
    likelihood: Likelihood = option(Likelihood(), "Log-likelihood of a frame.")
    modes: int = option(8, "Maximum number of modes kept between passes and returned.", minimum=1)
    every: float = option(
        0.0,
        "Keyframes: minimum time between frames; 0: all frames.",
        unit="s",
        flag="--every",
        panel=USED,
    )
    every_metre: float = option(
        0.0,
        "Keyframes: minimum distance between frames, or 0.2 rad of rotation; 0: all frames.",
        unit="m",
    )

    def __post_init__(self) -> None:
        if not (self.semantic or self.depth or self.colour):
            raise OptionError("semantic, depth and colour are all off; leave one on.")
        object.__setattr__(self, "heights", tuple(float(h) for h in self.heights))
        if not self.heights:
            raise OptionError("heights: give at least one height of the camera above the floor.")
        check_options(self)

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

    start: Literal["table", "uniform"] = option(
        "table", "Initial particles: at places of the visibility table, or uniform."
    )
    per_cell: int = option(3, "Particles per cell and height of a uniform start.", minimum=1)
    passes: tuple[Pass, ...] = option(ONE_PASS, "Passes over the sequence, coarse to fine.")
    kld: bool = option(True, "Adapt the number of particles by KLD-sampling.")
    kld_error: float = option(0.1, "epsilon of KLD-sampling.", above=0)
    kld_confidence: float = option(0.95, "1 - delta of KLD-sampling.", above=0, below=1)
    min_particles: int = option(
        24, "Minimum number of particles after KLD-sampling, if the pass has as many.", minimum=1
    )
    injection: float = option(
        0.1, "Share of particles injected from the table, or uniformly.", below=1
    )
    inject_every: int = option(0, "Frames between injections; 0: inject if the likelihood drops.")
    burn_in: int = option(
        0, "Number of initial frames that only move particles; the last frame is always scored."
    )
    pool_modes: bool = option(
        False, "Take the modes between passes from all frames of a pass, not only the last."
    )
    answer: Literal["fit", "mle"] = option(
        "fit",
        "`fit`: the best modes, fitted to the whole sequence; `mle`: the particles with the "
        "largest weights in the last pass; the first is the maximum likelihood estimate of "
        "Sec. 3.5.",
    )
    record: bool = option(False, "Keep all particles of all passes in the estimate, for pictures.")

    def __post_init__(self) -> None:
        PoseSearchOptions.__post_init__(self)
        if not self.passes:
            raise OptionError(
                "passes: the list is empty; give at least one pass, or use PoseSearchOptions."
            )

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
            raise OptionError(f"preset is {name!r}; choose one of {', '.join(presets)}.")
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
            burn_in=1,
            modes=8,
            pool_modes=True,
        )

    @classmethod
    def coarse(cls) -> FilterOptions:
        """The paper's recipe with its pass of stride 20 alone (App. E)."""
        paper = cls.paper()
        return replace(paper, passes=paper.passes[:1])


_LEAST = 1e-4  # m, rad: less would make one source silence all others


@dataclass(frozen=True, slots=True)
class DepthNoise:
    """Noise of depth readings about the map's surface."""

    floor: float = option(0.004, "Standard deviation of a reading at 0 m.", unit="m")
    slope: float = option(0.003, "Increase of the standard deviation per square metre.", unit="1/m")
    surface: float = option(
        0.008, "Standard deviation of the surface of the map.", unit="m", minimum=_LEAST
    )
    facing: tuple[float, float] = option(
        (0.5, 0.85),
        "Cosines of the angle between the normals of reading and map: below the first a reading has "
        "no weight, from the second on its full weight.",
        minimum=-1,
        maximum=1,
    )

    def __post_init__(self) -> None:
        check_options(self)
        if not self.facing[0] < self.facing[1]:
            raise OptionError(f"facing is {self.facing}; give two ascending cosines.")


@dataclass(frozen=True, slots=True)
class RefineOptions:
    """Options of the refinement of a pose (Sec. 3.6)."""

    depth: bool = option(True, "Align depth images with the mesh of the map.")
    images: bool | Literal["auto"] = option(
        "auto", "Match images with renderings; `auto`: if depth alone does not fix the pose."
    )
    joint: bool = option(
        True,
        "Refine all frames jointly in one robust fit near a coarse pose that is not `LOST`; "
        "otherwise use the frame with most inliers, as in the paper.",
    )
    views: int = option(
        1,
        "Rendered views per frame for matchers without a neighbourhood; with several, "
        "`auto` takes RoMa or SIFT. More than one view brings no gain if the initial yaw is "
        "within 10 degrees (benchmark; paper: 6).",
        minimum=1,
        maximum=72,
    )
    spread: float = option(
        pi / 4,
        "Half width of the rendered views in yaw (paper: 45 degrees).",
        unit="rad",
        maximum=pi,
    )
    frames: int | None = option(
        None,
        "Maximum number of frames with matched images, spread over the sequence; none: 12 "
        "with the guided matcher, 5 with slower ones.",
        minimum=1,
    )
    readings: int = option(1500, "Depth readings per frame.", minimum=1)
    reach: tuple[float, float] = option(
        (0.15, 0.12),
        "Standard deviations of a given start (`scene.refine`) in the plane [m] and in yaw [rad]; "
        "`localize` knows those of its own poses.",
        maximum=5,
    )
    inlier: float = option(
        8.0,
        "Reprojection error of an inlier of RANSAC.",
        unit="px in an image 640 px wide",
        above=0,
    )
    least: int = option(
        12, "Minimum number of inliers of a pose, in a frame or a sequence.", minimum=1
    )
    noise: DepthNoise = option(DepthNoise(), "Noise of depth readings.")
    motion: MotionNoise = option(
        MotionNoise(0.0025, 0.01, 0.00125, 0.005), "Noise of the odometry from frame to frame."
    )
    tilt: float = option(
        0.005, "Standard deviation of the direction of gravity.", unit="rad", minimum=_LEAST
    )
    check: bool = option(
        True, "Keep the coarse pose if held-out pixels do not confirm the refined one."
    )

    def __post_init__(self) -> None:
        check_options(self)
        if not (self.depth or self.images):
            raise OptionError("depth and images are both off; leave one on, or refine=False.")
        if self.reach[1] > pi:
            raise OptionError(f"reach is {self.reach}; it must be at most pi.")

    @classmethod
    def preset(cls, name: str) -> RefineOptions | None:
        """Return the refinement of the preset of that name (`FilterOptions.preset`).

        None after ``published``: that is a filter only, whose code ends in another refinement.
        """
        paper = cls.paper()
        follows = {"default": cls(), "paper": paper, "published": None, "coarse": paper}
        if name not in follows:
            raise OptionError(f"preset is {name!r}; choose one of {', '.join(follows)}.")
        return follows[name]

    @classmethod
    def paper(cls) -> RefineOptions:
        """Return the paper's recipe: six views of every frame, PnP frame by frame, most inliers decide.

        Its matcher is RoMa; ``auto`` takes SIFT where RoMa is not at hand. The guided one, if named,
        knows where to look, and gets one view.
        """
        return cls(depth=False, images=True, joint=False, check=False, views=6, frames=1000)
