"""What a server counts: requests, errors, and how long the latest ones took."""

import time
from collections import Counter, defaultdict, deque
from typing import Any

import numpy as np

WINDOW = 2048  # latest durations kept of each kind


class ServerStats:
    """Counts since the start, and percentiles over the latest `WINDOW` durations of each kind."""

    def __init__(self) -> None:
        self._begun = time.monotonic()
        self._seconds: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=WINDOW))
        self.counts: Counter[str] = Counter()
        self.connections = 0

    def took(self, kind: str, seconds: float) -> None:
        """Note one finished piece of work."""
        self.counts[kind] += 1
        self._seconds[kind].append(seconds)

    def count(self, kind: str, by: int = 1) -> None:
        """Count something that has no duration."""
        self.counts[kind] += by

    def percentiles(self, kind: str) -> dict[str, float] | None:
        """p50, p95 and the longest in milliseconds, or None before the first."""
        seconds = self._seconds.get(kind)
        if not seconds:
            return None
        p50, p95 = np.percentile(np.fromiter(seconds, float), [50, 95])
        return {"p50": round(p50 * 1e3, 2), "p95": round(p95 * 1e3, 2), "max": round(max(seconds) * 1e3, 2)}

    def snapshot(self) -> dict[str, Any]:
        """Everything as plain numbers and texts."""
        batches = self.counts["batch"]
        return {
            "uptime_s": round(time.monotonic() - self._begun, 1),
            "connections": self.connections,
            "counts": dict(sorted(self.counts.items())),
            "mean_batch": round(self.counts["batched"] / batches, 2) if batches else None,
            "latency_ms": {kind: self.percentiles(kind) for kind in sorted(self._seconds)},
        }

    def line(self) -> str:
        """One line for a log."""
        infer = self.percentiles("infer")
        times = f"p50 {infer['p50']:.0f} ms, p95 {infer['p95']:.0f} ms" if infer else "none yet"
        mean = self.snapshot()["mean_batch"]
        batch = f", {mean} to a batch" if mean else ""
        return (
            f"{self.connections} clients · {self.counts['infer']} inferences ({times}{batch}) · "
            f"{self.counts['refused']} requests refused, {self.counts['failed']} failed"
        )
