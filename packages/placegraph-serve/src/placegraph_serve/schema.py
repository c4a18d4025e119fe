"""Bodies of requests in JSON, as OpenAPI shows them."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from placegraph_serve.problem import refused

Near = Annotated[
    list[float] | None,
    Field(min_length=2, max_length=2, description="Longitude and latitude [deg], in this order."),
]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=False)

    @classmethod
    def read(cls, text: str | bytes, name: str) -> Self:
        """Read what came as text, and is named so; `RequestError` says what is wrong with it."""
        try:
            return cls.model_validate_json(text)
        except ValidationError as error:
            raise refused(error.errors(), name) from None


class Thing(_Body):
    """What a question is about."""

    words: str = Field(max_length=200)
    label: str = Field("", max_length=200)
    wind: str = Field("", max_length=10)


class Asked(_Body):
    """A question of an earlier answer, as it came."""

    text: str = Field(max_length=1000)
    options: list[str] = Field(max_length=20)
    things: list[Thing] = Field(max_length=20)
    gain: float = 0.0


class Answered(_Body):
    """An answer to a question."""

    question: Asked
    option: str = Field(max_length=200)


class Locate(_Body):
    """A sentence, and what is known beside it."""

    text: str = Field(description="What stands around the speaker, in words.")
    map: str | None = Field(None, description="Name of a map; all of them where not given.")
    near: Near = None
    radius: float | None = Field(None, gt=0, le=1e7, description="Radius of `near` [m]; 1000.")
    heading_deg: Finite | None = Field(
        None, description="Where the speaker looks, clockwise from north."
    )
    answers: list[Answered] = Field(default=[], max_length=30)
    language: str | None = Field(None, max_length=20)
    top: int | None = Field(None, ge=1, le=50, description="Modes at most; 5.")


class Intrinsics(_Body):
    """Of images as they are shown upright; width and height may be those of larger ones."""

    fx: Positive
    fy: Positive | None = None
    cx: Finite | None = None
    cy: Finite | None = None
    width: int | None = Field(None, ge=1, le=65536)
    height: int | None = Field(None, ge=1, le=65536)
    distortion: list[Finite] = Field(default=[], max_length=8)
    model: Literal["opencv", "fisheye"] = "opencv"


class PriorPose(_Body):
    """Roughly where the first image was taken, in the map."""

    x: Finite
    y: Finite
    z: Finite | None = None
    yaw_deg: Finite | None = None
    spread: Positive | None = None
    turn_deg: Positive | None = None


class Localize(_Body):
    """What is known of images, in order of time."""

    map: str | None = Field(None, description="Name of a map; all of them where not given.")
    intrinsics: Intrinsics | None = Field(None, description="Of EXIF where not given.")
    gravity: list[list[Finite]] | None = Field(
        None, max_length=1000, description="Its direction in each camera's axes (x, y, z)."
    )
    odometry: list[list[list[Finite]]] | None = Field(
        None, max_length=1000, description="odometry_from_camera (4, 4) of each image [m]."
    )
    stamps: list[Finite] | None = Field(None, max_length=1000)
    depth_scale: Positive = Field(1000.0, description="Units of the depth images in a metre.")
    description: str | None = Field(None, max_length=2000)
    prior: PriorPose | None = None
    near: Near = None
    radius: Positive = Field(100.0, le=1e7, description="Radius of `near` [m].")
    heading_deg: Finite | None = None
    pictures: list[Literal["plan", "overlay", "animation"]] = Field(default=[], max_length=3)
    seed: int = Field(0, ge=0)


class Begin(_Body):
    """Whom to follow: somebody in a city, or a camera in a scene."""

    map: str | None = None
    near: Near = None
    radius: Positive = 1000.0
    heading_deg: Finite | None = None
    camera: Intrinsics | None = None
    description: str | None = Field(None, max_length=2000)
    seed: int = Field(0, ge=0)


class Step(_Body):
    """One step: words and way in a city, a frame in a scene."""

    text: str | None = Field(None, max_length=2000)
    answers: list[Answered] = Field(default=[], max_length=30)
    east: Finite | None = None
    north: Finite | None = None
    sigma: Finite | None = None
    distance: Finite | None = None
    bearing_deg: Finite | None = None
    image: str | None = Field(None, description="JPEG or PNG in base64.")
    depth: str | None = Field(None, description="PNG of 16 bits in base64.")
    depth_scale: Positive = 1000.0
    odometry: list[list[Finite]] | None = Field(
        None, description="odometry_from_camera (4, 4) [m]."
    )
    gravity: list[Finite] | None = Field(None, description="Its direction in the camera's axes.")
    stamp: Finite | None = None


class Live(Locate):
    """The same while one types; `id` comes back with the answer."""

    id: int | str = 0
