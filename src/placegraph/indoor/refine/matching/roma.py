"""RoMa (Edstedt et al., CVPR 2024), the paper's matcher (Sec. 3.6), and Tiny RoMa, from `romatch`.

RoMa's code and weights are under the MIT licence, DINOv2, which it is built on, under Apache-2.0,
XFeat, which the tiny one is built on, under Apache-2.0. It wants a GPU: on a processor a pair takes
a minute; `kind="tiny"` takes a second. Features of the query are computed anew for each view: the
library offers no other way.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.errors import MissingExtraError, OptionError, ServiceError
from placegraph.indoor.refine.matching.dense import Warp, thinned
from placegraph.indoor.refine.matching.matches import Matches, ViewByView, blank, check_range
from placegraph.indoor.refine.matching.network import device_for, fitting, read_state, torch_for

if TYPE_CHECKING:
    from numpy.typing import NDArray

KINDS = ("indoor", "outdoor", "tiny")
_PATCH = 14  # DINOv2's
_SMALLEST = 32  # the tiny one sees nothing smaller


class RomaMatcher(ViewByView):
    """Dense matches, the surest of each block of pixels.

    Parameters
    ----------
    weights
        File with RoMa's weights (`roma_indoor.pth`, ...); None: from the authors' releases, kept
        in PyTorch's cache.
    backbone
        File with DINOv2's weights (`dinov2_vitl14_pretrain.pth`); None: from its own hub. The
        tiny one needs none.
    device
        `cpu`, `cuda` or `auto`.
    kind
        `indoor`, `outdoor`, or `tiny`.
    size
        Side of the square that images are first brought to [px], a multiple of 14; of the tiny one
        the longest side of larger images, whose memory grows with its fourth power.
    fine
        The same for the second look [px]; 0: none.
    count
        Most matches of a view.
    least
        Smallest certainty of a match.
    margin
        Matches nearer than this to where the map ends in a view are left out [px].

    Raises
    ------
    MissingExtraError
        `romatch`, or PyTorch, is not installed, or does not load.
    InputError
        Weights are missing, no weights, or another network's.
    ServiceError
        No file is given and the hub cannot be reached.
    OptionError
        An option is out of its range, or there is no such device.

    """

    name = "roma"

    def __init__(
        self,
        *,
        weights: Path | str | None = None,
        backbone: Path | str | None = None,
        device: str = "auto",
        kind: str = "indoor",
        size: int = 560,
        fine: int = 864,
        count: int = 2000,
        least: float = 0.05,
        margin: int = 4,
    ) -> None:
        if kind not in KINDS:
            raise OptionError(f"kind is {kind!r}; it is {', '.join(map(repr, KINDS))}.")
        if size % _PATCH or size <= 0 or fine % 8 or fine < 0:
            raise OptionError(
                f"size is {size} and fine {fine}; they must be multiples of {_PATCH} and of 8."
            )
        check_range(count=(count, 1, 1e6), least=(least, 0, 1), margin=(margin, 0, 1e4))
        self.count = count
        self.least = least
        self.margin = margin
        torch = torch_for(self.name, "roma")
        on = device_for(torch, device)
        self._network: Any = (
            _tiny(torch, on, weights)
            if kind == "tiny"
            else _whole(torch, on, kind, (weights, backbone), (size, fine))
        )
        self._network.eval()
        self._longest = size if kind == "tiny" else 0  # the others resize by themselves

    def matched(
        self, ours: NDArray[np.uint8], view: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> Matches:
        """Matches of the query (H, W, 3) with one view; see `Matcher.match`."""
        from PIL import Image

        sizes = ours.shape[:2], view.shape[:2]
        if blank(ours) or blank(view) or min(min(s) for s in sizes) < _SMALLEST:
            return Matches.none()
        both = [Image.fromarray(np.ascontiguousarray(image)) for image in (ours, view)]
        if self._longest:
            for image in both:
                image.thumbnail((self._longest, self._longest))
        warp, certainty = self._network.match(*both)
        return thinned(
            split(_single(warp, 3), _single(certainty, 2), symmetric=self._network.symmetric),
            *sizes,
            count=self.count,
            least=self.least,
            mask=mask,
            margin=self.margin,
        )


def split(
    warp: NDArray[np.float32], certainty: NDArray[np.float32], *, symmetric: bool
) -> list[Warp]:
    """RoMa's answer, warp (h, w, 4) and certainty (h, w), by direction.

    A symmetric network puts both side by side: on the left the query's pixels and where they lie in
    the view, on the right the view's pixels and where they lie in the query.
    """
    half = warp.shape[1] // 2
    parts = [slice(0, half), slice(half, None)] if symmetric else [slice(None)]
    return [Warp(warp[:, p, :2], warp[:, p, 2:], certainty[:, p]) for p in parts]


def _single(tensor: Any, axes: int) -> NDArray[np.float32]:  # noqa: ANN401
    """Array of a batch of one; the tiny network leaves the batch's axis out."""
    array = plain(tensor)
    return array[0] if array.ndim > axes else array


def imported(package: str, name: str) -> Any:  # noqa: ANN401  # the module
    """A package of the extra `roma`; `MissingExtraError` where it is missing or does not load."""
    import importlib

    try:
        return importlib.import_module(package)
    except (ImportError, RuntimeError) as error:  # RuntimeError: a torchvision for another torch
        raise MissingExtraError(
            f"The matcher {name!r} needs {package}: pip install 'placegraph[roma]' "
            f"({' '.join(str(error).split())[:120]})."
        ) from error


def plain(tensor: Any) -> NDArray[np.float32]:  # noqa: ANN401
    """float32 array of a tensor on any device."""
    array: NDArray[np.float32] = tensor.detach().float().cpu().numpy()
    return array


def state_of(torch: Any, path: Path | str | None, url: str, name: str) -> dict[str, Any]:  # noqa: ANN401
    """Weights from a file, else from a hub; nothing in either is run."""
    if path is not None:
        return read_state(torch, Path(path), name)
    try:
        state: dict[str, Any] = torch.hub.load_state_dict_from_url(
            url, map_location="cpu", weights_only=True
        )
    except OSError as error:  # urllib's errors are such
        raise ServiceError(
            f"{url} cannot be reached ({error}); download it elsewhere and name the file: "
            "weights=, and backbone= for DINOv2."
        ) from error
    return state


def _whole(
    torch: Any,  # noqa: ANN401
    device: Any,  # noqa: ANN401
    kind: str,
    files: tuple[Path | str | None, Path | str | None],
    sizes: tuple[int, int],
) -> Any:  # noqa: ANN401
    """RoMa with its weights and DINOv2's."""
    zoo = imported("romatch.models.model_zoo", "roma")
    urls = zoo.weight_urls
    state = state_of(torch, files[0], urls["romatch"][kind], "roma")
    under = state_of(torch, files[1], urls["dinov2"], "DINOv2")
    make = zoo.roma_indoor if kind == "indoor" else zoo.roma_outdoor
    with fitting(files[0] or files[1], "roma"):
        return make(
            device=device,
            weights=state,
            dinov2_weights=under,
            coarse_res=sizes[0],
            upsample_res=sizes[1] or sizes[0],
            upsample_preds=bool(sizes[1]),
            use_custom_corr=False,  # an extension of its own that few have
        )


def _tiny(torch: Any, device: Any, weights: Path | str | None) -> Any:  # noqa: ANN401
    """Tiny RoMa with its weights, which include XFeat's."""
    zoo = imported("romatch.models.model_zoo", "roma")
    xfeat = imported("kornia.feature", "roma").XFeat()
    state = state_of(torch, weights, zoo.weight_urls["tiny_roma_v1"]["outdoor"], "roma")
    with fitting(weights, "roma"):
        return zoo.tiny_roma_v1_model(weights=state, xfeat=xfeat.net).to(device)
