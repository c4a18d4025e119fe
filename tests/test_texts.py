"""The texts that a person may see, in one list: a change shows up in review."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_list_of_texts_is_current():
    script = [sys.executable, "tools/collect_texts.py"]
    collected = subprocess.run(  # noqa: S603  (our own script)
        script, cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout
    current = Path(ROOT, "tests/texts.txt").read_text("utf-8")
    assert collected == current, (
        "a text has changed: read it, and renew the list by `python tools/collect_texts.py --write`"
    )
