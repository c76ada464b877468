"""Guard conditions: a callback that any thread can have an executor call."""

from collections.abc import Callable
from typing import Any

from .callback_groups import CallbackGroup
from .context import Context
from .exceptions import InvalidHandle, NotInitializedException
from .utilities import get_default_context

__all__ = ["GuardCondition"]


class GuardCondition:
    """Triggered any number of times before the executor looks, it calls back once."""

    def __init__(
        self,
        callback: Callable[..., Any] | None,
        callback_group: CallbackGroup | None,
        context: Context | None = None,
    ):
        context = get_default_context() if context is None else context
        if context.handle is None:
            raise NotInitializedException("cannot create guard condition")
        self._context_handle = context.handle
        self._triggered = False
        self._destroyed = False
        self.callback = callback
        self.callback_group = callback_group
        self._executor_event = False

    def trigger(self) -> None:
        """Have the callback called soon; raises InvalidHandle after `destroy`."""
        if self._destroyed:
            raise InvalidHandle("cannot use Destroyable because destruction was requested")
        self._triggered = True
        self._context_handle.wake_all()

    def destroy(self) -> None:
        """Forget that it was triggered, and be triggered no more."""
        self._destroyed = True
        self._triggered = False
