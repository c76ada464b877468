"""Which callbacks may run at the same time as which others in a MultiThreadedExecutor."""

import weakref
from threading import Lock
from typing import Any


class CallbackGroup:
    """Subscriptions, timers, services, … whose callbacks are scheduled together."""

    def __init__(self) -> None:
        self.entities: set[weakref.ReferenceType[Any]] = set()

    def add_entity(self, entity: Any) -> None:
        """Make an entity a member of this group."""
        self.entities.add(weakref.ref(entity, self.entities.discard))

    def has_entity(self, entity: Any) -> bool:
        """Whether an entity is a member of this group."""
        return weakref.ref(entity) in self.entities

    def can_execute(self, entity: Any) -> bool:  # noqa: ARG002
        """Whether an entity's callback may start now."""
        raise RuntimeError(
            f"{type(self).__name__} does not say when callbacks may run; use "
            "MutuallyExclusiveCallbackGroup or ReentrantCallbackGroup"
        )

    def beginning_execution(self, entity: Any) -> bool:
        """Reserve the group for an entity's callback; False when it may not start."""
        return self.can_execute(entity)

    def ending_execution(self, entity: Any) -> None:
        """Give the group back after an entity's callback."""


class ReentrantCallbackGroup(CallbackGroup):
    """Callbacks that may run at the same time as each other."""

    def can_execute(self, entity: Any) -> bool:  # noqa: ARG002
        return True


class MutuallyExclusiveCallbackGroup(CallbackGroup):
    """Callbacks of which only one runs at a time."""

    def __init__(self):
        super().__init__()
        self._active_entity = None
        self._lock = Lock()

    def can_execute(self, entity: Any) -> bool:
        assert weakref.ref(entity) in self.entities
        return self._active_entity is None

    def beginning_execution(self, entity: Any) -> bool:
        with self._lock:
            assert weakref.ref(entity) in self.entities
            if self._active_entity is None:
                self._active_entity = entity
                return True
        return False

    def ending_execution(self, entity: Any) -> None:
        with self._lock:
            assert self._active_entity is entity
            self._active_entity = None
