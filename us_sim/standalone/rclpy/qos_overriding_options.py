"""Quality of service that a person may change by parameters when the node starts.

`qos_overrides./topic.publisher.depth:=1` and the like, for the policies that the node allows.
"""

import copy
from collections.abc import Callable, Iterable
from operator import attrgetter
from typing import Any

from ..messages import message_class
from . import qos as policies
from .duration import Duration
from .exceptions import ParameterAlreadyDeclaredException
from .parameter import Parameter
from .qos import QoSPolicyEnum, QoSPolicyKind, QoSProfile


class InvalidQosOverridesError(Exception):
    """The callback of the options rejects the profile that the overrides lead to."""


class QoSOverridingOptions:
    """Which policies may be overridden, and who checks the outcome."""

    policy_kinds = property(attrgetter("_policy_kinds"))
    callback = property(attrgetter("_callback"))
    entity_id = property(attrgetter("_entity_id"))

    def __init__(
        self,
        policy_kinds: Iterable[QoSPolicyKind],
        *,
        callback: Callable[[QoSProfile], Any] | None = None,
        entity_id: str | None = None,
    ):
        self._policy_kinds = policy_kinds
        self._callback = callback
        self._entity_id = entity_id

    @classmethod
    def with_default_policies(
        cls,
        *,
        callback: Callable[[QoSProfile], Any] | None = None,
        entity_id: str | None = None,
    ) -> "QoSOverridingOptions":
        """Allow history, depth and reliability to be overridden."""
        kinds = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY)
        return cls(kinds, callback=callback, entity_id=entity_id)


def overridden(
    kind: str,
    node: Any,
    topic_name: str,
    qos: QoSProfile,
    options: QoSOverridingOptions | None,
) -> QoSProfile:
    """A profile after a node's overrides for a 'publisher' or 'subscription' of an absolute topic.

    Declares a read-only parameter for each policy that may be overridden.
    """
    if options is None:
        return qos
    qos = copy.copy(qos)
    suffix = "" if options.entity_id is None else f"_{options.entity_id}"
    description = f"for {kind} `{topic_name}` with id `{options.entity_id}`"
    for policy in options.policy_kinds:
        if kind == "subscription" and policy == QoSPolicyKind.LIFESPAN:
            continue
        policy_name = policy.name.lower()
        name = f"qos_overrides.{topic_name}.{kind}{suffix}.{policy_name}"
        descriptor = message_class("rcl_interfaces/msg/ParameterDescriptor")(
            description=f"{policy_name} {description}", read_only=True
        )
        try:
            parameter = node.declare_parameter(name, _parameter_value(qos, policy), descriptor)
        except ParameterAlreadyDeclaredException:
            parameter = node.get_parameter(name)
        _apply(qos, policy, parameter)
    if options.callback is not None:
        result = options.callback(qos)
        if not result.successful:
            raise InvalidQosOverridesError(
                f"Provided QoS overrides {description}, are not valid: {result.reason}"
            )
    return qos


def _parameter_value(qos: QoSProfile, policy: QoSPolicyKind) -> str | int | bool:
    value = getattr(qos, policy.name.lower())
    if isinstance(value, QoSPolicyEnum):
        if value.name == "UNKNOWN":
            raise ValueError("User provided QoS profile is invalid")
        return value.name.lower()
    return value.nanoseconds if isinstance(value, Duration) else value


def _apply(qos: QoSProfile, policy: QoSPolicyKind, parameter: Parameter) -> None:
    name, value = policy.name.lower(), parameter.value
    current = getattr(qos, name)
    if isinstance(current, QoSPolicyEnum):
        choices: Any = getattr(policies, f"{name.capitalize()}Policy")
        if value.upper() not in choices.__members__:
            raise RuntimeError(f"Unexpected QoS override for policy `{name}`: `{value}`")
        value = choices[value.upper()]
    elif isinstance(current, Duration):
        value = Duration(nanoseconds=value)
    setattr(qos, name, value)
