"""Texts: a person's marks of moments."""

from __future__ import annotations

from typing import Any

import rerun

from us_sim.to_rerun.rerun_file import RerunFile


class Texts:
    """``std_msgs/String``."""

    def take(self, entity: str, message: Any, file: RerunFile) -> None:
        """Log the text."""
        file.log(entity, rerun.TextLog(message.data))
