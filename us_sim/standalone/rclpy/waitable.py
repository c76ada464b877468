"""Anything else that an executor can wait for."""

from typing import Any

from .callback_groups import CallbackGroup

__all__ = ["Waitable"]


class Waitable:
    """Subclasses say when they are ready, take their data, and execute with it."""

    def __init__(self, callback_group: CallbackGroup):
        self.callback_group = callback_group
        callback_group.add_entity(self)
        self._executor_event = False
        self._futures: list[Any] = []

    def add_future(self, future):
        """Have a future's callbacks run by the executor that executes this."""
        self._futures.append(future)

    def remove_future(self, future):
        """The counterpart of `add_future`."""
        self._futures.remove(future)

    def is_ready(self, wait_set):  # noqa: ARG002
        """Whether there is data to take."""
        return False

    def take_data(self):
        """The data to execute with; None when there is none."""

    async def execute(self, taken_data):
        """Do what is to be done with the data."""
