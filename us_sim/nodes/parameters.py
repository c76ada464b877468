"""Settings as ROS parameters: declared with unit and range, read, and changed while running.

A number that need not be given is 0 in a parameter where it is not, such a list is one of zeros,
and such a text is empty, since ROS parameters have no value for nothing.
"""

from __future__ import annotations

import dataclasses
import json
from array import array
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, get_args, get_origin

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from us_sim.errors import UsSimError
from us_sim.nodes.settings import is_live
from us_sim.settings.quantity import dial_unit
from us_sim.settings.setting import Settings, kinds_of, rules_of

S = TypeVar("S", bound=Settings)


def declared(node: Node, settings: S, names: Collection[str] | None = None, prefix: str = "") -> S:
    """Declare parameters for settings; return the settings with the values given at the start.

    Args:
        node: that gets the parameters.
        settings: the values by default.
        names: the settings that are parameters; None is all.
        prefix: what goes before their names.

    Raises:
        SettingsError: or the settings' own error: a value will not do; the node's name and the
            parameter's come first.
    """
    cls = type(settings)
    chosen = [name for name in rules_of(cls) if names is None or name in names]
    given = [
        node.declare_parameter(prefix + name, _raw(settings, name), _descriptor(cls, name))
        for name in chosen
    ]
    return changed(settings, given, prefix, f"{node.get_name()}.")


@dataclass(frozen=True)
class Group:
    """Settings that are parameters together."""

    settings: Settings  # the values by default
    prefix: str = ""  # before the parameters' names
    names: Collection[str] | None = None  # of the settings that are parameters; None is all


class LiveSettings:
    """Settings of a node as parameters, some of which may change while it runs.

    Args:
        node: that gets the parameters.
        groups: by a name for each.
        prepare: called with the settings of all groups, by the groups' names, before a change is
            taken; what it raises refuses it.
        use: called likewise when parameters have been set.

    Raises:
        SettingsError: or the settings' own error: a value given at the start will not do.
    """

    def __init__(
        self,
        node: Node,
        groups: Mapping[str, Group],
        prepare: Callable[[dict[str, Any]], None] | None = None,
        use: Callable[[dict[str, Any]], None] | None = None,
    ) -> None:
        self._node, self._groups = node, groups
        self._prepare, self._use = prepare, use
        self.values: dict[str, Any] = {
            key: declared(node, group.settings, group.names, group.prefix)
            for key, group in groups.items()
        }
        self._checked = self.values  # of the change that is about to be made
        node.add_on_set_parameters_callback(self._on_set)
        node.add_post_set_parameters_callback(self._on_post_set)

    def restore(self, values: Mapping[str, Any]) -> None:
        """Set parameters back to former settings, by the groups' names."""
        back = [
            Parameter(self._groups[key].prefix + name, value=_raw(settings, name))
            for key, settings in values.items()
            for name in rules_of(type(settings))
            if getattr(settings, name) != getattr(self.values[key], name)
        ]
        if back:
            self._node.set_parameters_atomically(back)  # one alone may not go with another

    def _on_set(self, parameters: list[Parameter]) -> SetParametersResult:
        """Make the settings as they would be; what refuses that refuses the parameters."""
        try:
            checked = {
                key: changed(settings, parameters, self._groups[key].prefix)
                for key, settings in self.values.items()
            }
            if checked != self.values and self._prepare is not None:
                self._prepare(checked)
        except UsSimError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self._checked = checked
        return SetParametersResult(successful=True)

    def _on_post_set(self, _: list[Parameter]) -> None:
        """Use the settings that were checked, now that the parameters have been set."""
        if self._checked != self.values:
            self.values = self._checked
            if self._use is not None:
                self._use(self.values)


def changed(settings: S, parameters: Sequence[Parameter], prefix: str = "", before: str = "") -> S:
    """Make the settings with the values of parameters that are theirs.

    Args:
        settings: as they are.
        parameters: of which some may be others'.
        prefix: before the names of theirs.
        before: likewise, in the sentence of an error.

    Raises:
        SettingsError: or the settings' own error: a value will not do.
    """
    values = {each.name: each.value for each in parameters}
    changes = {
        name: _value(kind, values[prefix + name])
        for name, kind in kinds_of(type(settings)).items()
        if prefix + name in values
    }
    if not changes:
        return settings
    try:
        return dataclasses.replace(settings, **changes)
    except UsSimError as error:
        at = f"{before}{prefix}{error.key}: {error.problem}" if error.key else str(error)
        raise type(error)(at) from error


def parameters_with(settings: Settings) -> list[Parameter]:
    """List the parameters that settings are."""
    return [Parameter(name, value=_raw(settings, name)) for name in rules_of(type(settings))]


def _value(kind: Any, raw: Any) -> Any:
    """Convert a parameter's value to that of a setting of this type."""
    if kind is str and isinstance(raw, int | float):
        return str(raw)  # a camera's number, say
    is_list = not isinstance(raw, str) and hasattr(raw, "__iter__")
    if _may_be_none(kind) and not (any(raw) if is_list else raw):
        return None
    if get_origin(kind) is tuple and get_args(kind)[0] is str:
        return tuple(text for text in raw or () if text)
    return raw


def _raw(settings: Settings, name: str) -> Any:
    """Convert a setting's value to that of a parameter."""
    value, kind = getattr(settings, name), kinds_of(type(settings))[name]
    lists = [each for each in (kind, *get_args(kind)) if get_origin(each) is tuple]
    if lists:
        if get_args(lists[0])[0] is str:
            return list(value) or [""]
        return array("d", value or (0.0,))  # an empty list would have no type
    if value is not None:
        return value
    return next({int: 0, float: 0.0}.get(each, "") for each in get_args(kind))


def _descriptor(settings: type[Settings], name: str) -> ParameterDescriptor:
    """The description of a setting that `ros2 param describe` shows.

    What ROS has no field for is a JSON object in ``additional_constraints``: ``unit`` (SI),
    ``shown_in`` (the unit on a dial), ``choices`` (their meanings by name, as far as told),
    ``none`` (the value that stands for none), ``live`` (whether it may change while the node runs).
    """
    rule, kind = rules_of(settings)[name], kinds_of(settings)[name]
    live = is_live(settings, name)
    told: dict[str, Any] = {"live": live}
    if rule.quantity and rule.quantity.unit:
        told |= {"unit": rule.quantity.unit, "shown_in": dial_unit(rule.quantity)}
    meanings = rule.choice.in_short if rule.choice else {}
    if names := rule.choice.names if rule.choice else rule.choices:
        told["choices"] = {each: meanings.get(each, "") for each in names}
    if _may_be_none(kind):
        told["none"] = "" if str in get_args(kind) else 0
    descriptor = ParameterDescriptor(
        description=rule.description,
        additional_constraints=json.dumps(told, ensure_ascii=False),
        read_only=not live,
        dynamic_typing=kind is str and not live,
    )
    if rule.quantity is not None:  # ROS has no range for lists
        low, high = rule.quantity.minimum, rule.quantity.maximum
        kinds = get_args(kind) if _may_be_none(kind) else (kind,)
        low = min(low, 0.0) if _may_be_none(kind) else low
        if float in kinds:
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
        elif int in kinds:
            whole = IntegerRange(from_value=int(low), to_value=int(high), step=1)
            descriptor.integer_range = [whole]
    return descriptor


def _may_be_none(kind: Any) -> bool:
    return type(None) in get_args(kind)
