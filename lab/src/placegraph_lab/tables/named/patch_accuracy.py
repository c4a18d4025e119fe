"""Which object does a patch show? Encoders where poses are known: house, office, drawn homes.

    placegraph-lab table patch_accuracy
    placegraph-lab table patch_accuracy --encoders "appearance; labels" --every 5

An encoder is a name and options, such as `features weights="dinov2.safetensors"`. Prints a Markdown
table and writes every row as JSON.
"""

from __future__ import annotations

from typing import Annotated, Any

from placegraph.indoor.encode import Encoder, bound, encoder
from placegraph_lab.tables.retrieval.patch_accuracy import Accuracy, accuracy, mean, report
from placegraph_lab.tables.retrieval.patch_places import HOMES, places
from placegraph_lab.tables.run import Quick, Run, option, parts, table


@table()
def patch_accuracy(
    run: Run,
    encoders: Annotated[str, option("Names and options.")] = "appearance; labels",
    every: Annotated[int, option("Of the recordings' frames, every so many.")] = 2,
    homes: Annotated[int, option("Drawn homes.")] = HOMES,
    *,
    quick: Quick = False,
) -> None:
    """Which object does a patch show? Encoders where poses are known: house, office, homes."""
    if quick:
        every, homes = 10, 2
    asked: dict[str, Encoder] = {}
    for spec in parts(encoders, ";"):
        asked[spec] = encoder(spec)
    rows: list[dict[str, Any]] = []
    found: dict[str, dict[str, list[Accuracy | None]]] = {}
    for place in run.track(places(run.data, run.cache, every, homes), total=3 + homes):
        for spec, one in asked.items():
            tied = bound(one, place.scene, place.captures)
            told = accuracy(tied, place.scene, place.frames, place.map_from_camera)
            found.setdefault(place.kind, {}).setdefault(spec, []).append(told)
            row = None if told is None else told.to_dict()
            rows.append({"place": place.name, "encoder": spec, "key": one.key, "accuracy": row})
    means = {
        kind: {spec: mean(told) for spec, told in by_encoder.items()}
        for kind, by_encoder in found.items()
    }
    print(report(means))
    run.save({"rows": rows})
