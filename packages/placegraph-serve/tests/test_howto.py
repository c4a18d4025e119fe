"""What the how-to asks with curl is answered."""

import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[3] / "docs" / "howto-serve.md"
LINES = re.findall(r"^curl .*$", PAGE.read_text("utf-8"), re.MULTILINE)


@pytest.mark.parametrize("line", LINES, ids=lambda line: line[:60])
def test_curl(line, running, maps, tmp_path):
    if shutil.which("curl") is None:
        pytest.skip("curl is not installed")
    (tmp_path / "walk").symlink_to(maps.parent / "raw" / "walk")
    words = shlex.split(line.replace("http://127.0.0.1:8000", running.url))
    out = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True)  # noqa: S603
    if "-o" in words:
        assert (tmp_path / "plan.png").read_bytes().startswith(b"\x89PNG")
    elif "/metrics" in line:
        assert "placegraph_requests_total{" in out.stdout
    else:
        told = json.loads(out.stdout)
        assert "code" not in told, told
        assert told.get("maps") or told.get("features") or told["estimate"]["modes"]
