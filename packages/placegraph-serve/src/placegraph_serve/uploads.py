"""Files of a multipart form, laid into a folder that is gone with the answer."""

from __future__ import annotations

import shutil
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData, UploadFile

from placegraph.errors import InputError, RequestError
from placegraph_serve.limits import check_depth
from placegraph_serve.options import ServeOptions
from placegraph_serve.requests import Localize

if TYPE_CHECKING:
    from fastapi import Request


@asynccontextmanager
async def uploaded(request: Request, options: ServeOptions) -> AsyncIterator[dict[str, Any]]:
    """What `localize` is asked: the folder with what was sent, its files by name, the request.

    Raises
    ------
    InputError
        The form holds neither images nor a capture, or a field is no JSON.
    RequestError
        It holds too many files, or too large ones.

    """
    form = request.form(max_files=2 * options.images + 2, max_fields=20, max_part_size=1 << 20)
    async with form as fields:
        known = await _known(fields, options)
        files: dict[str, list[UploadFile]] = {
            name: [f for f in fields.getlist(name) if isinstance(f, UploadFile)]
            for name in ("images", "depth", "capture")
        }
        for field in ("images", "depth"):
            for i, file in enumerate(files[field]):
                if (file.size or 0) > options.image_bytes:
                    raise RequestError(
                        f"{field}[{i}] has {file.size:,} bytes; send at most "
                        f"{options.image_bytes:,}.",
                        status=413,
                        code="image_size",
                    )
        captures = files["capture"]
        if bool(files["images"]) == bool(captures) or len(captures) > 1:
            raise InputError(
                "images: send one or more as multipart form data, or else one `capture` as a ZIP."
            )
        with TemporaryDirectory(prefix="placegraph-") as folder:
            names = await run_in_threadpool(_laid, files, Path(folder))
            yield {
                "folder": folder,
                "images": names["images"],
                "depth": names["depth"],
                "capture": names["capture"][0] if captures else None,
                "request": known.model_dump(),
            }


async def _known(form: FormData, options: ServeOptions) -> Localize:
    """The form's field `request`, whether it came as text or as a file."""
    field = form.get("request") or "{}"
    text = await field.read() if isinstance(field, UploadFile) else field.encode()
    if len(text) > options.json_bytes:
        raise RequestError(
            f"request: {len(text):,} bytes; send at most {options.json_bytes:,}.",
            status=413, code="body_size",
        )  # fmt: skip
    check_depth(text, options.depth)
    return Localize.read(text, "request")


def _laid(files: dict[str, list[UploadFile]], folder: Path) -> dict[str, list[str]]:
    """Copy files into a folder, under names of our own."""
    names: dict[str, list[str]] = {}
    for field, sent in files.items():
        names[field] = [f"{field}-{i}" for i in range(len(sent))]
        for name, file in zip(names[field], sent, strict=True):
            with (folder / name).open("wb") as out:
                shutil.copyfileobj(file.file, out)
    return names
