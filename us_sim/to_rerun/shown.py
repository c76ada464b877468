"""What a kind of message becomes in a recording of rerun."""

from __future__ import annotations

from typing import Any, Protocol

from us_sim.to_rerun.rerun_file import RerunFile


class Shown(Protocol):
    """Logs messages of one type, each at the time that the file has been told."""

    def take(self, entity: str, message: Any, file: RerunFile) -> None:
        """Log a message.

        Args:
            entity: the topic's name without its first slash.
            message: as a bag gives it.
            file: that it goes to.

        Raises:
            UsSimError: the message cannot be used.
        """
