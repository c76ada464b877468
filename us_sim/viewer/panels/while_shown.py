"""A part of the page that knows whether a person can see it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import ui
from nicegui.element import Element


class WhileShown(Element, component="while_shown.js"):
    """What is within is worked for only while it can be seen.

    Args:
        begin: called when a person begins to see it.
        end: called when nobody sees it any more: another tab is chosen, the drawer is closed, or
            the browser has gone.
        every: s between two calls of ``refresh`` while it is seen, the first at once.
        refresh: brings up to date what is shown.
    """

    def __init__(
        self,
        begin: Callable[[], None],
        end: Callable[[], None],
        every: float,
        refresh: Callable[[], None],
    ) -> None:
        super().__init__()
        self.classes("us-while-shown")
        self._begin, self._end, self._refresh = begin, end, refresh
        self._is_shown = False
        with self:
            self._timer = ui.timer(every, refresh, active=False, immediate=True)
        self.on("shown", lambda event: self._show(bool(event.args)))
        self.client.on_disconnect(lambda: self._show(False))
        self.client.on_delete(lambda: self._show(False))
        self.client.on_connect(self._ask)

    def close(self) -> None:
        """It is about to be taken off the page."""
        self._show(False)

    def _ask(self) -> Any:
        """A page that was away for a moment does not know that it was."""
        return self.run_method("again")

    def _show(self, is_shown: bool) -> None:
        if is_shown == self._is_shown:
            return
        self._is_shown = is_shown
        (self._begin if is_shown else self._end)()
        self._timer.active = is_shown
        if is_shown:
            self._refresh()
