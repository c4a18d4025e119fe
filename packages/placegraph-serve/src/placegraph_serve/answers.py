"""Answers of the routes for OpenAPI: their schemas, problems and examples."""

from __future__ import annotations

from typing import Any, Literal

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel, ConfigDict, Field

from placegraph_serve.problem import MEDIA_TYPE
from placegraph_serve.requests import Localize, QuestionBody

Numbers = list[float]
GeoJson = dict[str, Any]


class _Answer(BaseModel):
    model_config = ConfigDict(extra="allow")


class ProblemAnswer(_Answer):
    """Error (RFC 9457)."""

    type: str
    title: str
    status: int
    detail: str = Field(description="What is wrong, and how to mend it.")
    advice: str = Field(alias="mend")
    code: str = Field(description="Word for programs.")
    retry_after: int | None = Field(None, description="Seconds to wait.")


class HealthAnswer(_Answer):
    """State of the server."""

    status: Literal["ok", "starting"]


class MapAnswer(_Answer):
    """One map; `problem` says why it cannot be opened."""

    name: str
    kind: Literal["city", "scene", "library", "shards", "world"]
    objects: int
    bounds: Numbers | None = Field(description="West, south, east, north [deg].")
    anchored: bool
    bytes: int
    problem: str = ""


class MapsAnswer(_Answer):
    """All maps."""

    maps: list[MapAnswer]


class EvidenceAnswer(_Answer):
    """Statement or sense that speaks for a mode or against it."""

    statement: str
    verdict: Literal["for", "against", "silent"]
    weight: float | None = Field(description="Log-likelihood ratio.")
    objects: list[dict[str, Any]]
    note: str


class ModeAnswer(_Answer):
    """Place, room or pose."""

    probability: float | None
    longitude: float | None = None
    latitude: float | None = None
    covariance: list[list[float | None]] | None = None
    evidence: list[EvidenceAnswer]


class EstimateAnswer(_Answer):
    """Answer to "where am I?"."""

    status: Literal["OK", "AMBIGUOUS", "LOST"]
    reason: str
    remainder: float | None = Field(description="Probability of other places than the modes.")
    modes: list[ModeAnswer]


class LocateAnswer(_Answer):
    """Answer to a sentence."""

    map: str | None
    estimate: EstimateAnswer
    support: list[Numbers] | None = Field(
        None, description="Longitude, latitude [deg], probability of the posterior's points."
    )
    question: QuestionBody | None
    geojson: GeoJson | None
    seconds: float


class LocalizeAnswer(_Answer):
    """Answer to images."""

    map: str | None
    estimate: EstimateAnswer
    geopose: dict[str, Any] | None
    geojson: GeoJson | None
    pictures: dict[str, str | None] = Field(description="Data URLs by name.")
    notes: list[str]
    seconds: float


class StepAnswer(_Answer):
    """Answer to a step."""

    map: str | None = Field(description="None: all cities.")
    estimate: EstimateAnswer
    geojson: GeoJson | None
    seconds: float


class SessionAnswer(_Answer):
    """Session that was opened."""

    session: str
    expires_s: float
    map: str | None = Field(description="None: all cities.")


class FeaturesAnswer(_Answer):
    """GeoJSON as Photon answers it."""

    type: Literal["FeatureCollection"]
    features: list[dict[str, Any]]


class GeoPoseAnswer(_Answer):
    """Answer of the GeoPose protocol."""

    id: str
    type: Literal["geopose"]
    accuracy: dict[str, float]
    geopose: dict[str, Any]
    status: Literal["OK", "AMBIGUOUS", "LOST"]
    reason: str
    source: Literal["images", "geolocation"]
    modes: list[dict[str, Any]]
    notes: list[str]


JSON, PNG = "application/json", "image/png"
ANSWERS: dict[tuple[str, str], tuple[str, str, type[BaseModel] | None]] = {
    ("/healthz", "get"): ("200", JSON, HealthAnswer),
    ("/metrics", "get"): ("200", "text/plain", None),
    ("/v1/maps", "get"): ("200", JSON, MapsAnswer),
    ("/v1/maps/{name}/plan.png", "get"): ("200", PNG, None),
    ("/v1/maps/{name}/drawing", "get"): ("200", JSON, _Answer),
    ("/v1/maps/{name}/drawing.png", "get"): ("200", PNG, None),
    ("/v1/maps/{name}/drawing/{level}/{x}/{y}", "get"): ("200", JSON, _Answer),
    ("/v1/locate", "post"): ("200", JSON, LocateAnswer),
    ("/v1/localize", "post"): ("200", JSON, LocalizeAnswer),
    ("/v1/sessions", "post"): ("201", JSON, SessionAnswer),
    ("/v1/sessions/{session}", "post"): ("200", JSON, StepAnswer),
    ("/api", "get"): ("200", JSON, FeaturesAnswer),
    ("/reverse", "get"): ("200", JSON, FeaturesAnswer),
    ("/geopose", "post"): ("200", JSON, GeoPoseAnswer),
}
"""Status, media type and schema of the answer of a route; None: no JSON."""
SAID = "A bakery is north of me. The church is east of the bakery."
EXAMPLES: dict[tuple[str, str], Any] = {
    ("/v1/locate", "post"): {"text": SAID},
    ("/v1/sessions", "post"): {"camera": {"fx": 500.0, "width": 640, "height": 480}},
    ("/v1/sessions/{session}", "post"): {"distance": 20.0, "bearing_deg": 90.0},
}
"""Bodies that show how a route is asked."""
PROBLEM = {"type": "urn:placegraph:problem:map_unknown", "title": "The request is invalid",
           "status": 404, "detail": "There is no map 'paris'; the maps are: monaco.",
           "mend": "The maps are: monaco.", "code": "map_unknown"}  # fmt: skip
REF = "#/components/schemas/{model}"


def describe_api(app: FastAPI) -> dict[str, Any]:
    """Return the OpenAPI document of an application: every answer and error has a schema."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, routes=app.routes)
        schemas = document["components"]["schemas"]
        for name in ("HTTPValidationError", "ValidationError"):  # errors are problems
            schemas.pop(name, None)
        models: list[type[BaseModel]] = [Localize, ProblemAnswer]
        for model in models + [model for *_, model in ANSWERS.values() if model]:
            schema = model.model_json_schema(ref_template=REF)
            schemas |= schema.pop("$defs", {})
            schemas[model.__name__] = schema
        for path, methods in document["paths"].items():
            for method, operation in methods.items():
                _describe_answers(operation, path, method)
        session, steps = (document["paths"][f"/v1/sessions{end}"] for end in ("", "/{session}"))
        session["post"]["responses"]["201"]["links"] = {
            method: {
                "operationId": step["operationId"],
                "parameters": {"session": "$response.body#/session"},
            }
            for method, step in steps.items()
        }
        app.openapi_schema = document
    return app.openapi_schema


def _describe_answers(operation: dict[str, Any], path: str, method: str) -> None:
    responses = operation["responses"]
    responses.pop("422", None)
    found = ANSWERS.get((path, method))
    if found is not None:
        status, kind, model = found
        schema = {} if model is None else {"$ref": REF.format(model=model.__name__)}
        responses[status] = {"description": "Answer.", "content": {kind: {"schema": schema}}}
    if path == "/healthz":
        responses["503"] = responses["200"]
    schema = {"$ref": REF.format(model=ProblemAnswer.__name__)}
    responses["default"] = {
        "description": "Problem (RFC 9457).",
        "content": {MEDIA_TYPE: {"schema": schema, "example": PROBLEM}},
    }
    if (path, method) in EXAMPLES:
        operation["requestBody"]["content"][JSON]["example"] = EXAMPLES[path, method]
