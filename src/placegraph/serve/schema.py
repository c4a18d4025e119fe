"""Bodies of requests in JSON, as OpenAPI shows them."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Near = Annotated[
    list[float] | None,
    Field(min_length=2, max_length=2, description="Longitude and latitude [deg], in this order."),
]
Degrees = Annotated[float, Field(allow_inf_nan=False)]


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=False)


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
    heading_deg: Degrees | None = Field(
        None, description="Where the speaker looks, clockwise from north."
    )
    answers: list[Answered] = Field(default=[], max_length=30)
    language: str | None = Field(None, max_length=20)
    top: int | None = Field(None, ge=1, le=50, description="Modes at most; 5.")


class Live(Locate):
    """The same while one types; `id` comes back with the answer."""

    id: int | str = 0
