"""What a server counts, as Prometheus reads it."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Mapping
from itertools import accumulate

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
BOUNDS = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 120.0)
"""Of the histogram of seconds."""
PATHS = ("/v1/locate", "/v1/localize", "/v1/maps", "/v1/sessions", "/geopose", "/api")


class Metrics:
    """Requests by path and status, and how long they took."""

    def __init__(self) -> None:
        self.requests: Counter[tuple[str, int]] = Counter()
        self._buckets: dict[str, list[int]] = {}
        self._seconds: Counter[str] = Counter()

    def note(self, path: str, status: int, seconds: float) -> None:
        """Count an answer."""
        known = next((p for p in PATHS if path == p or path.startswith(f"{p}/")), "other")
        self.requests[known, status] += 1
        self._seconds[known] += seconds  # type: ignore[assignment]  # a Counter of floats
        counts = self._buckets.setdefault(known, [0] * (len(BOUNDS) + 1))
        counts[bisect_left(BOUNDS, seconds)] += 1

    def text(self, now: Mapping[str, float]) -> str:
        """All of it, and `now`: values at this moment by name."""
        lines = ["# TYPE placegraph_requests_total counter"]
        for (path, status), count in sorted(self.requests.items()):
            lines.append(f'placegraph_requests_total{{path="{path}",status="{status}"}} {count}')
        name = "placegraph_request_seconds"
        lines.append(f"# TYPE {name} histogram")
        for path, counts in sorted(self._buckets.items()):
            bounds = [*map(str, BOUNDS), "+Inf"]
            for bound, count in zip(bounds, accumulate(counts), strict=True):
                lines.append(f'{name}_bucket{{path="{path}",le="{bound}"}} {count}')
            lines += [
                f'{name}_sum{{path="{path}"}} {self._seconds[path]:.6f}',
                f'{name}_count{{path="{path}"}} {sum(counts)}',
            ]
        for key, value in now.items():
            kind = "counter" if key.partition("{")[0].endswith("_total") else "gauge"
            lines += [
                f"# TYPE placegraph_{key.partition('{')[0]} {kind}",
                f"placegraph_{key} {value:g}",
            ]
        return "\n".join([*dict.fromkeys(lines), ""])
