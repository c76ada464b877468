"""What all parts of a node share: where they belong, how they are named, how they end."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from ._context_handle import ContextHandle
from ._endpoints import NodeLink
from ._local_node import LocalNode
from ._names import expand
from .callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from .clock import ROSClock
from .context import Context
from .validate_full_topic_name import validate_full_topic_name
from .validate_topic_name import validate_topic_name
from .waitable import Waitable

__all__ = ["NodeParts"]


class NodeParts:
    """The base of what makes, lists and destroys parts; `Node` knows its name and context."""

    _context: Context
    _context_handle: ContextHandle
    _link: NodeLink
    _local_node: LocalNode
    _clock: ROSClock
    _name: str
    _namespace: str

    def __init__(self) -> None:
        self._waitables: list[Waitable] = []
        self._default_callback_group = MutuallyExclusiveCallbackGroup()

    if TYPE_CHECKING:

        def _wake_executor(self) -> None: ...
        def resolve_topic_name(self, topic: str, *, only_expand: bool = False) -> str: ...
        def resolve_service_name(self, service: str, *, only_expand: bool = False) -> str: ...

    @property
    def waitables(self) -> Iterator[Waitable]:
        yield from self._waitables

    @property
    def default_callback_group(self) -> CallbackGroup:
        return self._default_callback_group

    def add_waitable(self, waitable: Waitable) -> None:
        """Have something else executed when it is ready."""
        self._waitables.append(waitable)
        self._wake_executor()

    def remove_waitable(self, waitable: Waitable) -> None:
        """The counterpart of `add_waitable`."""
        self._waitables.remove(waitable)
        self._wake_executor()

    def _destroy(self, entity: Any, entities: list[Any]) -> bool:
        if entity not in entities:
            return False
        entities.remove(entity)
        entity.destroy()
        self._wake_executor()
        return True

    def _resolved(self, name: str, is_service: bool = False) -> str:
        """The absolute, remapped name, or the error that says what is wrong with the given one."""
        try:
            if is_service:
                return self.resolve_service_name(name)
            return self.resolve_topic_name(name)
        except RuntimeError:
            validate_topic_name(name, is_service=is_service)
            full_name = expand(name, self._name, self._namespace)
            validate_full_topic_name(full_name, is_service=is_service)
            raise

    def _joined(self) -> None:
        self._context_handle.announce()
        self._wake_executor()
