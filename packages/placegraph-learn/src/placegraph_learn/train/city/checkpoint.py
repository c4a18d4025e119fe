"""What an interrupted training goes on from: one folder, files without pickle, replaced whole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray

from placegraph.core.mapfile import pack_strings, read_map, write_map
from placegraph.errors import InputError
from placegraph.outdoor.network.batches import Fits
from placegraph.outdoor.network.graphs import TextGraphs
from placegraph_learn.train.city.pool import Pool
from placegraph_learn.train.training import planned

STATE, POOL = "training", "pool"
VERSION = 1


class Folder:
    """A folder that holds pools, the state after the last epoch, and the curves."""

    def __init__(self, path: str | PathLike[str], plan: Mapping[str, Any]) -> None:
        self.path = Path(path)
        self.plan = planned(path, plan)

    def write_state(
        self, epoch: int, model: torch.nn.Module, optimizer: torch.optim.Optimizer
    ) -> None:
        """Keep the network and the optimizer after an epoch."""
        arrays: dict[str, NDArray[Any]] = {}
        for name, p in model.named_parameters():
            state = optimizer.state[p]
            arrays[f"weight:{name}"] = p.detach().cpu().numpy()
            for moment in ("exp_avg", "exp_avg_sq"):
                arrays[f"{moment}:{name}"] = state[moment].cpu().numpy()
            steps = int(state["step"])
        write_map(self.path / "state", STATE, VERSION, {"epoch": epoch, "steps": steps}, arrays)

    def read_state(self, model: torch.nn.Module, optimizer: torch.optim.Optimizer) -> int:
        """Restore them; returns the number of finished epochs, 0 where there is none."""
        if not (self.path / "state").exists():
            return 0
        file = read_map(self.path / "state", STATE, VERSION)
        with torch.no_grad():
            for name, p in model.named_parameters():
                p.copy_(torch.from_numpy(file.array(f"weight:{name}", "<f4", p.ndim).copy()))
                optimizer.state[p] = {
                    "step": torch.tensor(float(file.meta["steps"])),
                    **{
                        moment: torch.from_numpy(
                            file.array(f"{moment}:{name}", "<f4", p.ndim).copy()
                        ).to(p.device)
                        for moment in ("exp_avg", "exp_avg_sq")
                    },
                }
        return int(file.meta["epoch"])


class PoolFolder:
    """Examples by name; those that are there are not made again."""

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = Path(path)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{path}: no folder for examples ({error}); name another.") from error

    def write(self, name: str, pool: Pool) -> None:
        """Keep examples."""
        arrays = {f"text:{f.name}": getattr(pool.texts, f.name) for f in fields(TextGraphs)}
        arrays["text:vocabulary"] = pack_strings(pool.texts.vocabulary)
        arrays |= {f"fit:{name}": column for name, column in pool.fits._asdict().items()}
        arrays |= {n: getattr(pool, n) for n in ("positions", "views", "scores", "right")}
        write_map(self.path / f"{name}.pool", POOL, VERSION, {}, arrays)

    def read(self, name: str) -> Pool | None:
        """Examples that were kept, or None."""
        path = self.path / f"{name}.pool"
        if not path.exists():
            return None
        file = read_map(path, POOL, VERSION)
        arrays = dict(file.arrays)
        texts: dict[str, Any] = {f.name: arrays[f"text:{f.name}"] for f in fields(TextGraphs)}
        texts["vocabulary"] = file.strings("text:vocabulary")
        fits = Fits(*(arrays[f"fit:{name}"] for name in Fits._fields))
        rest = {n: arrays[n] for n in ("positions", "views", "scores", "right")}
        return Pool(TextGraphs(**texts), fits, **rest)


def plan_of(cities: Mapping[str, int], options: object) -> dict[str, Any]:
    """What a training is: cities with their numbers of objects, and options."""
    return {"cities": dict(cities), "options": asdict(options)}  # type: ignore[call-overload]
