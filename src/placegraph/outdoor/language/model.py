"""A language model as parser, served at an address that speaks the OpenAI protocol."""

from __future__ import annotations

import json
from dataclasses import dataclass
from math import degrees, radians

from placegraph.errors import OptionError, ServiceError
from placegraph.language.check import check
from placegraph.outdoor.language.answer import SCHEMA, Answer
from placegraph.outdoor.language.description import Description
from placegraph.outdoor.language.words import NameFinder, Words

LONGEST_ANSWER = 1_000_000
"""Bytes."""

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


@dataclass(frozen=True)
class LanguageModelDescriber:
    """Reads a text by a language model; implements `Describer`.

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
        vocabulary: Words | None = None,
        names: NameFinder | None = None,
        heading: float | None = None,
    ) -> Description:
        """Return what the model understands of a text.

        `names` is not used: the model tells names by itself.

        Raises
        ------
        DescriptionError
            If the text is empty, too long, or no text.
        ServiceError
            If the service cannot be reached, refuses, or answers nonsense.
        """
        del names
        check(text)
        if vocabulary is None:
            from placegraph.outdoor.language.vocabulary import Vocabulary

            vocabulary = Vocabulary.default()
        return Answer(self._ask(text, heading), self.base_url).description(text, vocabulary)

    def _ask(self, text: str, heading: float | None) -> object:
        """Return the JSON that the model answers."""
        facing = (
            'The speaker\'s heading is not known: put "left", "behind" and the like under "ignored".'
            if heading is None
            else f"The speaker faces {degrees(heading % radians(360)):.0f} degrees."
        )
        request = {
            "model": self.model,
            "temperature": 0,
            "response_format": {"type": "json_object"},
            "messages": [
                {
                    "role": "system",
                    "content": PROMPT.format(schema=json.dumps(SCHEMA), heading=facing),
                },
                {"role": "user", "content": text},
            ],
        }
        answer = self._post(json.dumps(request).encode())
        try:
            return json.loads(json.loads(answer)["choices"][0]["message"]["content"])
        except (ValueError, LookupError, TypeError, RecursionError) as error:
            raise ServiceError(
                f"{self.base_url}: the language model's answer is no JSON ({error}). Ask again, or"
                f" use a larger model than {self.model!r}."
            ) from error

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
                f"{address}: the language model's service cannot be reached ({error}). Is it"
                " running?"
            ) from error
        if len(answer) > LONGEST_ANSWER:
            raise ServiceError(
                f"{address}: the answer is longer than {LONGEST_ANSWER:,} bytes. Is it a language"
                " model's service?"
            )
        return answer
