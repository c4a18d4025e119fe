"""The side panel of a page: what the estimate says, in words and bars."""

from __future__ import annotations

from math import exp
from typing import TYPE_CHECKING

import numpy as np

from placegraph.outdoor.language.description import LISTENER, SPEAKER
from placegraph.view.city.items import common_name
from placegraph.view.draw.svg import clean

if TYPE_CHECKING:
    from collections.abc import Callable

    from placegraph.estimate import CityEstimate, Evidence, ObjectRef, Place
    from placegraph.outdoor.language.description import Description, Mention, Statement

FULL_BAR = 5.0
"""Weight that fills a bar [nat]."""
WINDS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")
VERDICTS = {"for": ("✓", "speaks for it"), "against": ("✕", "speaks against it")}


def panel(estimate: CityEstimate, question: str | None, at: Callable[[float, float], str]) -> str:
    """Write the panel's contents.

    Parameters
    ----------
    estimate
        What to tell.
    question
        The question that would help most, or None.
    at
        Attributes that lead from longitude and latitude [deg] to the place on the page's map.

    """
    parts = [_said(estimate.understood), f'<p class="reason">{clean(estimate.reason)}</p>']
    if question:
        parts.append(f'<section class="ask"><h2>To tell more, I would ask</h2><p>{clean(question)}</p>'
                     "</section>")  # fmt: skip
    if estimate.modes:
        rows = "".join(
            _mode(mode, k, ranked=estimate.ranked) for k, mode in enumerate(estimate.modes)
        )
        parts.append(f'<section><h2>Places</h2><ol class="modes">{rows}</ol></section>')
        parts += [_evidence(mode, k, at) for k, mode in enumerate(estimate.modes)]
    if estimate.understood:
        parts.append(_understood(estimate.understood))
    return "\n".join(parts)


def _said(description: Description | None) -> str:
    """Quote the text; what was ignored is dimmed."""
    if description is None or not description.text.strip():
        return ""
    text, out, rest = description.text, [], 0
    for ignored in description.ignored:
        start = text.find(ignored.text, rest) if ignored.text else -1
        if start >= 0:
            end = start + len(ignored.text)
            out += [clean(text[rest:start]), f"<s>{clean(text[start:end])}</s>"]
            rest = end
    return f"<blockquote>{''.join(out)}{clean(text[rest:])}</blockquote>"


def _mode(mode: Place, k: int, *, ranked: bool) -> str:
    """Write one mode as a button; its probability, but where modes are only ranked."""
    spread = float(np.sqrt(np.linalg.eigvalsh(mode.covariance)[-1]))
    share = f"{100 * mode.probability:.0f}" if mode.probability >= 0.01 else "&lt;1"
    bar = (
        f'<span class="share"><b>{share} %</b>'
        f'<span class="bar"><i style="width:{100 * min(1.0, mode.probability):.1f}%"></i></span></span>'
    )
    return (
        f'<li><button type="button" data-mode="{k}" aria-pressed="{"true" if k == 0 else "false"}">'
        f'<span class="number">{k + 1}</span>'
        f'{"" if ranked else bar}<span class="where">'
        f"{mode.latitude:.5f}, {mode.longitude:.5f} · ± {spread:.0f} m · "
        f"cell {clean(mode.cell)}</span></button></li>"
    )


def _evidence(mode: Place, k: int, at: Callable[[float, float], str]) -> str:
    """Write what the statements say about one mode."""
    hidden = "" if k == 0 else " hidden"
    rows = "".join(_statement(evidence, at) for evidence in mode.evidence)
    rows = rows or '<li class="none">Nothing was said that can be compared.</li>'
    return (f'<section class="evidence" data-of="{k}"{hidden}>'
            f'<h2>Why place {k + 1}</h2><ul>{rows}</ul></section>')  # fmt: skip


def _statement(evidence: Evidence, at: Callable[[float, float], str]) -> str:
    """Write one statement with its verdict, weight and objects."""
    mark, words = VERDICTS.get(evidence.verdict, ("–", "says nothing about it"))
    verdict = evidence.verdict if evidence.verdict in VERDICTS else "silent"
    half = 50.0 * min(1.0, abs(evidence.weight) / FULL_BAR)
    side = "left" if evidence.weight >= 0 else "right"
    title = f"{words}: {factor(evidence.weight)} than anywhere"
    note = f'<p class="note">{clean(evidence.note)}</p>' if evidence.note else ""
    objects = "".join(_object(ref, at) for ref in evidence.objects)
    return (
        f'<li class="{verdict}"><span class="verdict" role="img" aria-label="{words}">{mark}</span>'
        f'<span class="statement">{clean(evidence.statement)}</span>'
        f'<span class="weight" role="img" aria-label="{title}" title="{title}">'
        f'<i style="{side}:50%;width:{half:.1f}%"></i></span>'
        f"{note}{f'<ul>{objects}</ul>' if objects else ''}</li>"
    )


def factor(weight: float) -> str:
    """Words for a log-likelihood ratio [nat]: ``32 times likelier``."""
    times = exp(min(abs(weight), 20.0))
    if times < 1.05:
        return "as likely"
    size = f"{times:.1f}" if times < 10 else f"{times:.0f}" if times < 1000 else "over 1000"
    return f"{size} times {'likelier' if weight > 0 else 'less likely'}"


def _object(ref: ObjectRef, at: Callable[[float, float], str]) -> str:
    """Write a map object as a button that leads to it."""
    name = clean(ref.name or common_name(ref.label))
    return (f'<li><button type="button" class="object" {at(ref.longitude, ref.latitude)}>{name}'
            f"<small>{clean(ref.label)} · {clean(ref.id)}</small></button></li>")  # fmt: skip


def _understood(description: Description) -> str:
    """Write how the text was read, and what was left."""
    mentions = {mention.id: mention for mention in description.mentions}
    things = "".join(
        _mention(mention)
        for mention in description.mentions
        if mention.id not in (SPEAKER, LISTENER)
    )
    statements = "".join(f"<li>{clean(reading(s, mentions))}</li>" for s in description.statements)
    ignored = "".join(
        f"<li><q>{clean(i.text)}</q> <small>{clean(i.reason)}</small></li>"
        for i in description.ignored
    )
    conflicts = "".join(f"<li>{clean(sentence)}</li>" for sentence in description.conflicts)
    blocks = [
        f"<h3>{head}</h3><ul>{rows}</ul>"
        for head, rows in (
            ("Contradictions", conflicts), ("Statements", statements), ("Things", things),
            ("Ignored", ignored),
        )
        if rows
    ]  # fmt: skip
    body = "".join(blocks) or "<p>Nothing.</p>"
    return (
        f'<details open class="understood"><summary>What was understood</summary>{body}</details>'
    )


def _mention(mention: Mention) -> str:
    """Write a thing and what it may mean on a map."""
    senses = "".join(
        f'<span class="sense">{clean(sense.label)}'
        f"{f' {sense.weight:.0%}' if sense.weight < 0.995 else ''}</span>"
        for sense in mention.senses[:6]
    )
    more = f"<small>and {len(mention.senses) - 6} more</small>" if len(mention.senses) > 6 else ""
    name = f'<span class="sense name">{clean(mention.name)}</span>' if mention.name else ""
    nothing = "" if senses or name else "<small>unknown</small>"
    return f"<li><q>{clean(mention.words)}</q> {name}{senses}{more}{nothing}</li>"


def reading(statement: Statement, mentions: dict[int, Mention]) -> str:
    """Words for a statement as it was read: ``a bakery: north of me, about 30 m``."""

    def words(node: int | None) -> str:
        if node == SPEAKER:
            return "me"
        if node == LISTENER:
            return "you"
        known = mentions.get(node) if node is not None else None
        return (known.name or known.words) if known else "something"

    target = words(statement.target)
    if statement.target2 is not None:
        target += f" and {words(statement.target2)}"
    relation = statement.relation.value
    if statement.bearing is not None:
        relation = WINDS[round(statement.bearing / (np.pi / 4)) % 8] + " of"
    elif relation == "direction":
        relation = "in some direction from"
    relation = {"visible": "in sight of", "same": "at", "across": "across from"}.get(
        relation, relation
    )
    about = f", about {statement.distance:.0f} m" if statement.distance is not None else ""
    no = "not " if statement.negated else ""
    return f"{words(statement.source)}: {no}{relation} {target}{about}"
