"""How the nodes are: their states as text, what they measure as curves."""

from __future__ import annotations

import math
from typing import Any

import rerun

from us_sim.to_rerun.rerun_file import RerunFile

CURVES = {"rate_hz": "rate", "latency_p50_ms": "latency", "residual": "residual"}
"""Keys of diagnostics, and what their curves are called."""
_LEVELS = (
    rerun.TextLogLevel.INFO,
    rerun.TextLogLevel.WARN,
    rerun.TextLogLevel.ERROR,
    rerun.TextLogLevel.WARN,
)


class Diagnostics:
    """``diagnostic_msgs/DiagnosticArray``: a curve for each node and key, a line at each change."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[int, str]] = {}

    def take(self, entity: str, message: Any, file: RerunFile) -> None:
        """Log what each node says of itself."""
        for status in message.status:
            node = status.name.strip("/") or "node"
            for item in status.values:
                if item.key in CURVES and (value := _number(item.value)) is not None:
                    file.log(f"{entity}/{CURVES[item.key]}/{node}", rerun.Scalars(value))
            level = int(status.level)
            if self._last.get(node) != (level, status.message):
                self._last[node] = level, status.message
                text = rerun.TextLog(
                    f"{node}: {status.message}", level=_LEVELS[min(max(level, 0), 3)]
                )
                file.log(f"{entity}/state/{node}", text)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
