"""Read an OpenStreetMap file once and keep nothing, in a process that may die of it.

osmium assembles areas in C++, and some damaged files end the process there. Run by `survived`, as
a file: so it imports nothing of placegraph and starts in a sixth of a second.
"""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path


def read_through(path: str, ending: str, storage: str, keys: list[str]) -> None:
    """Assemble all areas; what osmium itself finds wrong is for the reader to say."""
    import osmium

    with suppress(RuntimeError, OSError, ValueError):
        file = osmium.FileProcessor(osmium.io.File(path, ending)).with_locations(storage)
        wanted = osmium.filter.KeyFilter(*keys)  # looks at all tags, which may be damaged, too
        nothing = osmium.filter.IdFilter([])
        for _ in file.with_areas(wanted).with_filter(wanted).with_filter(nothing):
            pass


def survived(path: Path, ending: str, storage: str, keys: list[str]) -> None:
    """Raise `InputError` where a process dies of reading a file; costs an eighth of reading it.

    `MapError` where it died of a full disk, on which `storage` has its index of nodes.
    """
    from placegraph.errors import InputError
    from placegraph.files import cannot_write

    command = [sys.executable, "-P", __file__, str(path.absolute()), ending, storage, *keys]
    try:
        died = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)  # noqa: S603
    except OSError:  # no process can be started, as in a sandbox: read as it is
        return
    if died.returncode == -signal.SIGBUS and "," in storage:  # a page has no place on the disk
        room = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        raise cannot_write(Path(storage.partition(",")[2]), room)
    if died.returncode < 0:
        raise InputError(
            f"{path} is damaged: reading it ends osmium, by {signal.strsignal(-died.returncode)}. "
            "Download or export it again."
        )


if __name__ == "__main__":
    read_through(sys.argv[1], sys.argv[2], sys.argv[3], sys.argv[4:])
