"""RoMa v2 (Edstedt et al. 2025), from `romav2`.

Its code and weights are under the MIT licence; DINOv3, which it is built on and whose weights are
within its own, has a licence of its own (Meta's DINOv3 License): read it before you use this. The
library fetches DINOv3's code from its repository at a fixed commit when a network is first made.
"""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np

from placegraph.errors import OptionError, ServiceError
from placegraph.indoor.refine.matching.dense import Warp, thinned
from placegraph.indoor.refine.matching.matches import Matches, ViewByView, blank, check_range
from placegraph.indoor.refine.matching.network import device_for, fitting, read_state, torch_for
from placegraph.indoor.refine.matching.roma import imported, plain

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

SETTINGS = ("turbo", "fast", "base", "precise")
_SMALLEST = 32
"""In smaller images there is nothing to match [px]."""


class RomaV2Matcher(ViewByView):
    """Dense matches, the surest of each block of pixels.

    Parameters
    ----------
    weights
        File with its weights (`romav2.0.1.pt`); None: from the authors' releases, kept in
        PyTorch's cache.
    device
        `auto`, or the one that the library takes: it runs on the GPU where PyTorch sees one.
    setting
        `turbo` (320 px), `fast` (512), `base` (640) or `precise` (800, then 1280, both ways).
    count
        Most matches of a view.
    least
        Smallest certainty of a match.
    margin
        Matches nearer than this to where the map ends in a view are left out [px].

    Raises
    ------
    MissingExtraError
        `romav2`, or PyTorch, is not installed, or does not load.
    InputError
        Weights are missing, no weights, or another network's.
    ServiceError
        A hub cannot be reached.
    OptionError
        An option is out of its range, or the library would run on another device.

    """

    name = "romav2"

    def __init__(
        self,
        *,
        weights: Path | str | None = None,
        device: str = "auto",
        setting: str = "fast",
        count: int = 2000,
        least: float = 0.05,
        margin: int = 4,
    ) -> None:
        if setting not in SETTINGS:
            raise OptionError(f"setting is {setting!r}; it is {', '.join(map(repr, SETTINGS))}.")
        check_range(count=(count, 1, 1e6), least=(least, 0, 1), margin=(margin, 0, 1e4))
        self.count = count
        self.least = least
        self.margin = margin
        torch = torch_for(self.name, "roma")
        wanted = device_for(torch, device)
        romav2 = imported("romav2", self.name)
        taken = imported("romav2.device", self.name).device
        if device != "auto" and wanted.type != taken.type:
            raise OptionError(
                f"device is {device!r}, but romav2 runs on {taken.type!r} here and lets nobody "
                "choose; hide the GPU from PyTorch, or take device='auto'."
            )
        with fitting(weights, self.name), _weights_from(torch, weights):
            self._network = romav2.RoMaV2()
        self._network.apply_setting(setting)
        self._network.eval()

    def matched(
        self, ours: NDArray[np.uint8], view: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> Matches:
        """Matches of the query (H, W, 3) with one view; see `Matcher.match`."""
        sizes = ours.shape[:2], view.shape[:2]
        if blank(ours) or blank(view) or min(min(s) for s in sizes) < _SMALLEST:
            return Matches.none()
        answer = self._network.match(ours.copy(), view.copy())
        return thinned(
            directions(answer),
            *sizes,
            count=self.count,
            least=self.least,
            mask=mask,
            margin=self.margin,
        )


def directions(answer: dict[str, Any]) -> list[Warp]:
    """RoMa v2's answer by direction: `warp_AB` (1, h, w, 2) and `overlap_AB` (1, h, w, 1)."""
    ab, certainty = plain(answer["warp_AB"])[0], plain(answer["overlap_AB"])[0, ..., 0]
    found = [Warp(_own(ab), ab, certainty)]
    if answer.get("warp_BA") is not None:
        ba, certainty = plain(answer["warp_BA"])[0], plain(answer["overlap_BA"])[0, ..., 0]
        found.append(Warp(ba, _own(ba), certainty))
    return found


def _own(warp: NDArray[np.float32]) -> NDArray[np.float32]:
    """Normalised coordinates (h, w, 2) of a warp's own pixels."""
    height, width = warp.shape[:2]
    y, x = ((2.0 * np.arange(n) + 1.0) / n - 1.0 for n in (height, width))
    grid: NDArray[np.float32] = np.stack(np.meshgrid(x, y), axis=-1).astype(np.float32)
    return grid


@contextmanager
def _weights_from(torch: Any, weights: Path | str | None) -> Iterator[None]:  # noqa: ANN401
    """While a network is made, its weights come from a file, or from the hub without running them.

    The library knows no file: it asks PyTorch's hub as it is made, and would unpickle what comes.
    """
    fetch = torch.hub.load_state_dict_from_url

    def load(url: str, **options: Any) -> Any:  # noqa: ANN401
        if weights is not None:
            return read_state(torch, Path(weights), "romav2")
        return fetch(url, **{**options, "weights_only": True})

    try:
        with patch.object(torch.hub, "load_state_dict_from_url", load):
            yield
    except OSError as error:  # urllib's errors are such
        raise ServiceError(
            f"RoMa v2's hub cannot be reached ({error}); download romav2.0.1.pt elsewhere and name "
            "the file: weights=. DINOv3's code comes from a hub of its own."
        ) from error
