"""Guard conditions: a callback that any thread can have an executor call."""

from collections.abc import Callable
from typing import Any

from ._rclpy_pybind11 import Destroyable
from .callback_groups import CallbackGroup
from .context import Context
from .utilities import get_default_context


class GuardCondition(Destroyable):
    """Triggered any number of times before the executor looks, it calls back once."""

    _executor_event = False

    def __init__(
        self,
        callback: Callable[..., Any] | None,
        callback_group: CallbackGroup | None,
        context: Context | None = None,
    ):
        context = get_default_context() if context is None else context
        context._require_init("guard condition")
        self._context = context
        self._triggered = False
        self.callback = callback
        self.callback_group = callback_group

    def trigger(self) -> None:
        """Have the callback called soon; raises InvalidHandle after `destroy`."""
        self._require_existence()
        self._triggered = True
        self._context._wake_all()

    def destroy(self) -> None:
        """Forget that it was triggered, and be triggered no more."""
        super().destroy()
        self._triggered = False

    def _stirred(self) -> bool:
        return self._triggered

    _fetch = _stirred

    def _take(self) -> Callable[..., Any] | None:
        self._triggered = False
        return self.callback
