"""A language model as parser, at an address that speaks the OpenAI protocol, and its checked answer."""

from __future__ import annotations

import json
from dataclasses import dataclass
from math import degrees, radians
from typing import Any

from placegraph.errors import OptionError, ServiceError
from placegraph.language.text import IgnoredText, check_text
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    Description,
    Mention,
    Relation,
    Statement,
    find_conflicts,
)
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.language.words import NameFinder

LONGEST_ANSWER = 1_000_000
"""Bytes of the longest answer."""
SIGMA = 0.5
"""Standard deviation of a direction [rad] if the answer gives none."""
LARGEST = 1e9
"""Largest number of an answer; this also keeps out infinity and what is no number."""
_PEOPLE = {"speaker": SPEAKER, "listener": LISTENER}

PROMPT = """\
You turn a description of a place into a graph. Answer with one JSON object that fits this schema,
and nothing else:
{schema}
A source, a target or a target2 is "speaker" (whoever speaks: the place that is sought), "listener"
("you": whoever is told the way), or the number of a thing, counted from 0. A thing that is spoken
of twice is one thing. Its "noun" is its common noun in the singular, its "name" its proper name as
written; empty where there is none. The source of a statement is described relative to its target:
"direction": it lies at bearing_deg, clockwise from north, as seen from the target;
"near": close by, or at distance_m; "inside": in its area; "along": on a line, as a street;
"same": at the target itself; "visible": in sight of the target; "across": a road, or target2, lies
between them; "between": it lies between target and target2.
"far" marks what is said of a walk or of the whole town, "negated" what is said not to be so.
{heading} Put what you are not sure of under "ignored", with the reason; never guess."""


def _list_of(most: int, required: list[str], **types: str | list[str] | None) -> dict[str, Any]:
    """Return the schema of a list of at most `most` objects with fields of these types."""
    relations = {"enum": [str(relation) for relation in Relation]}
    fields = {key: relations if kind is None else {"type": kind} for key, kind in types.items()}
    item = {"type": "object", "required": required, "properties": fields}
    return {"type": "array", "maxItems": most, "items": item}


SCHEMA: dict[str, Any] = {
    "type": "object",
    "required": ["things", "statements", "ignored"],
    "properties": {
        "things": _list_of(
            200, ["words"], words="string", noun="string", name="string",
            count=["integer", "null"], definite="boolean",
        ),
        "statements": _list_of(
            400, ["relation", "source", "target"], relation=None,
            source=["string", "integer"], target=["string", "integer"],
            target2=["string", "integer", "null"], bearing_deg=["number", "null"],
            distance_m=["number", "null"], negated="boolean", far="boolean", certainty="number",
            text="string",
        ),
        "ignored": _list_of(400, ["text"], text="string", reason="string"),
    },
}  # fmt: skip
"""Form of an answer (JSON Schema)."""
_TYPES: dict[str, type | tuple[type, ...]] = {
    "object": dict, "array": list, "string": str, "boolean": bool, "integer": int,
    "number": (int, float), "null": type(None),
}  # fmt: skip


@dataclass(frozen=True)
class LanguageModelDescriber:
    """Reads a text by a language model.

    Parameters
    ----------
    base_url
        Address before ``/chat/completions``: ``http://127.0.0.1:8000/v1``.
    model
        Name of the model there.
    api_key
        Sent as a bearer token, if given.
    timeout
        Seconds to wait for an answer.
    """

    base_url: str
    model: str
    api_key: str | None = None
    timeout: float = 30.0

    def __post_init__(self) -> None:
        if not self.base_url.startswith(("http://", "https://")):
            raise OptionError(
                f"base_url is {self.base_url!r}; give an address that starts with http:// or"
                " https://."
            )
        if not self.timeout > 0.0:
            raise OptionError(f"timeout is {self.timeout}; give seconds above 0.")

    def describe(
        self,
        text: str,
        *,
        vocabulary: Vocabulary | None = None,
        names: NameFinder | None = None,
        heading: float | None = None,
    ) -> Description:
        """Return the model's reading of a text.

        `names` is not used: the model tells names by itself.

        Raises
        ------
        DescriptionError
            If the text is empty, too long, or no text.
        ServiceError
            If the service cannot be reached, refuses, or answers nonsense.
        """
        del names
        check_text(text)
        facing = (
            'The speaker\'s heading is not known: put "left", "behind" and the like under "ignored".'
            if heading is None
            else f"The speaker faces {degrees(heading % radians(360)):.0f} degrees."
        )
        system = PROMPT.format(schema=json.dumps(SCHEMA), heading=facing)
        request = {
            "model": self.model,
            "temperature": 0,
            "response_format": {"type": "json_object"},
            "messages": [
                {"role": "system", "content": system},
                {"role": "user", "content": text},
            ],
        }
        reply = self._post(json.dumps(request).encode())
        try:
            content = json.loads(json.loads(reply)["choices"][0]["message"]["content"])
        except (ValueError, LookupError, TypeError, RecursionError) as error:
            raise ServiceError(
                f"{self.base_url}: the language model's answer is not JSON ({error}). Ask "
                f"again, or use a larger model than {self.model!r}."
            ) from error
        return Answer(content, self.base_url).describe(text, vocabulary or Vocabulary.default())

    def _post(self, body: bytes) -> bytes:
        from http.client import HTTPException
        from urllib.error import HTTPError
        from urllib.request import Request, urlopen

        headers = {"Content-Type": "application/json"}
        if self.api_key:
            headers["Authorization"] = f"Bearer {self.api_key}"
        address = f"{self.base_url.rstrip('/')}/chat/completions"
        request = Request(address, body, headers)  # noqa: S310  http or https: __post_init__
        try:
            with urlopen(request, timeout=self.timeout) as reply:  # noqa: S310
                answer: bytes = reply.read(LONGEST_ANSWER + 1)
        except HTTPError as error:
            with error:
                raise ServiceError(
                    f"{address}: the language model's service refused with {error.code}"
                    f" ({error.reason}). Check base_url, model and api_key."
                ) from error
        except TimeoutError as error:
            raise ServiceError(
                f"{address}: no answer within {self.timeout:g} s. Give more time by timeout=."
            ) from error
        except (OSError, HTTPException) as error:
            raise ServiceError(
                f"{address}: the language model's service cannot be reached ({error}); "
                "check that it is running."
            ) from error
        if len(answer) > LONGEST_ANSWER:
            raise ServiceError(
                f"{address}: the answer is longer than {LONGEST_ANSWER:,} bytes; check that "
                "the URL is a language model's service."
            )
        return answer


class Answer:
    """Answer of a language model that fits the schema.

    Parameters
    ----------
    service
        Address, for messages.

    Raises
    ------
    ServiceError
        Naming the field that does not fit.
    """

    def __init__(self, content: object, service: str) -> None:
        self.service = service
        self._check(content, SCHEMA, "answer")
        self.content: Any = content

    def describe(self, text: str, vocabulary: Vocabulary) -> Description:
        """Return the query graph that the answer stands for."""
        things = self.content["things"]
        nouns = ["", "", *(str(thing.get("noun", "")).lower() for thing in things)]
        mentions = [Mention(SPEAKER, "I"), Mention(LISTENER, "you")]
        for i, thing in enumerate(things, start=2):
            senses = vocabulary.senses(nouns[i]) if nouns[i] else ()
            count = thing.get("count") or 0
            name, definite = thing.get("name", ""), thing.get("definite", True)
            mentions.append(
                Mention(i, thing["words"], senses, name, count if count >= 2 else None, definite)
            )
        statements = [
            self._statement(item, f"statements[{i}]", len(mentions))
            for i, item in enumerate(self.content["statements"])
        ]
        here = {SPEAKER}.union(
            s.target
            for s in statements
            if s.relation is Relation.SAME and s.source == SPEAKER and not s.negated
        )
        ignored = [
            IgnoredText(item["text"], item.get("reason", "left out by the language model"))
            for item in self.content["ignored"]
        ]
        conflicts = find_conflicts(statements, nouns, here)
        return Description(text, tuple(mentions), tuple(statements), tuple(ignored), conflicts)

    def _statement(self, item: dict[str, Any], where: str, n_mentions: int) -> Statement:
        relation = Relation(item["relation"])
        source, target, target2 = (
            None if item.get(end) is None else self._node(item[end], f"{where}.{end}", n_mentions)
            for end in ("source", "target", "target2")
        )
        bearing, distance = item.get("bearing_deg"), item.get("distance_m")
        certainty = item.get("certainty", 1.0)
        if source is None or target is None or source == target:
            raise self._error(f"{where}.target", "is the source itself")
        if (relation is Relation.DIRECTION) != (bearing is not None):
            raise self._error(f"{where}.bearing_deg", "belongs to a direction, and only there")
        if relation is Relation.BETWEEN and target2 is None:
            raise self._error(f"{where}.target2", "is missing between two things")
        if distance is not None and not 0.0 <= distance <= 1e6:
            raise self._error(f"{where}.distance_m", f"is {distance}, not in 0 to 1,000,000")
        if not 0.0 < certainty <= 1.0:
            raise self._error(f"{where}.certainty", f"is {certainty}, not in (0, 1]")
        return Statement(
            relation,
            source,
            target,
            target2,
            bearing=None if bearing is None else radians(bearing % 360.0),
            bearing_sigma=SIGMA,
            distance=distance,
            negated=item.get("negated", False),
            certainty=float(certainty),
            far=item.get("far", LISTENER in (source, target)),
            text=item.get("text", ""),
        )

    def _node(self, value: str | int, where: str, n_mentions: int) -> int:
        node = _PEOPLE.get(value) if isinstance(value, str) else value + 2
        if node is None or not 0 <= node < n_mentions or (node < 2 and not isinstance(value, str)):
            raise self._error(
                where, f"is {value!r}, which is neither a person nor the index of an object"
            )
        return node

    def _check(self, value: object, schema: dict[str, Any], where: str) -> None:
        """Check a value against the part of JSON Schema that `SCHEMA` uses."""
        if "enum" in schema:
            if value not in schema["enum"]:
                raise self._error(where, f"is {value!r}, not one of {', '.join(schema['enum'])}")
            return
        kinds = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
        fits = any(
            isinstance(value, _TYPES[kind]) and (kind == "boolean" or not isinstance(value, bool))
            for kind in kinds
        )
        sane = not isinstance(value, (int, float)) or abs(value) <= LARGEST
        if not fits or not sane:
            raise self._error(where, f"is {str(value)[:60]!r}, not of type {' or '.join(kinds)}")
        if isinstance(value, dict):
            self._check_object(value, schema, where)
        elif isinstance(value, list):
            if len(value) > schema["maxItems"]:
                raise self._error(where, f"has {len(value)} items, more than {schema['maxItems']}")
            for i, item in enumerate(value):
                self._check(item, schema["items"], f"{where}[{i}]")

    def _check_object(self, value: dict[str, Any], schema: dict[str, Any], where: str) -> None:
        for key in schema["required"]:
            if key not in value:
                raise self._error(f"{where}.{key}", "is missing")
        for key, item in value.items():
            if key not in schema["properties"]:
                raise self._error(f"{where}.{key}", "is an unexpected field")
            self._check(item, schema["properties"][key], f"{where}.{key}")

    def _error(self, field: str, fault: str) -> ServiceError:
        return ServiceError(
            f"{self.service}: in the language model's answer, {field} {fault}. Ask again, or use a"
            " larger model."
        )
