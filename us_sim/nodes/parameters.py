"""Settings as ROS parameters: declared with unit and range, read, and changed while running."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, TypeVar, get_args

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from us_sim.errors import UsSimError
from us_sim.nodes.settings import is_live, may_be_none, to_parameter_value, to_setting_value
from us_sim.settings.quantity import choose_dial_unit
from us_sim.settings.setting import Settings, kinds_of, rules_of

S = TypeVar("S", bound=Settings)


def declare_settings(
    node: Node, settings: S, names: Collection[str] | None = None, prefix: str = ""
) -> S:
    """Declare parameters for settings; return the settings with the values given at the start.

    Args:
        node: that gets the parameters.
        settings: the values by default.
        names: the settings that are parameters; None is all.
        prefix: before their names.

    Raises:
        UsSimError: the settings' own: a value is refused; node and parameter are named.
    """
    cls = type(settings)
    chosen = [name for name in rules_of(cls) if names is None or name in names]
    given = [
        node.declare_parameter(prefix + name, _raw(settings, name), _descriptor(settings, name))
        for name in chosen
    ]
    return settings_with(settings, given, prefix, f"{node.get_name()}.")


class LiveSettings:
    """Settings of a node as parameters, some of which may change while it runs.

    Settings have keys; a key that ends with a dot is the prefix of its parameters' names.

    Args:
        node: that gets the parameters.
        settings: the values by default, by their keys.
        check: called with all settings, by their keys, before a change; its error refuses that.
        use: called with them after a change.
        names: the settings that are parameters, by key, where not all are.
    """

    def __init__(
        self,
        node: Node,
        settings: Mapping[str, Settings],
        check: Callable[[dict[str, Any]], None] | None = None,
        use: Callable[[dict[str, Any]], None] | None = None,
        names: Mapping[str, Collection[str]] | None = None,
    ) -> None:
        self._node, self._check, self._use = node, check, use
        self.values: dict[str, Any] = {
            key: declare_settings(node, given, (names or {}).get(key), _prefix(key))
            for key, given in settings.items()
        }
        self._checked = self.values  # with the change that is about to be made
        node.add_on_set_parameters_callback(self._on_set)
        node.add_post_set_parameters_callback(self._on_post_set)

    def restore_settings(self, values: Mapping[str, Any]) -> None:
        """Set parameters back to former settings, by their keys."""
        back = [
            Parameter(_prefix(key) + name, value=_raw(settings, name))
            for key, settings in values.items()
            for name in rules_of(type(settings))
            if getattr(settings, name) != getattr(self.values[key], name)
        ]
        if back:
            self._node.set_parameters_atomically(back)  # one alone may not go with another

    def _on_set(self, parameters: list[Parameter]) -> SetParametersResult:
        """Make the settings as they would be; refuse the parameters if that fails."""
        try:
            checked = {
                key: settings_with(settings, parameters, _prefix(key))
                for key, settings in self.values.items()
            }
            if checked != self.values and self._check is not None:
                self._check(checked)
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


def _prefix(key: str) -> str:
    return key if key.endswith(".") else ""


def settings_with(
    settings: S, parameters: Sequence[Parameter], prefix: str = "", before: str = ""
) -> S:
    """Return the settings with the values of those parameters that are theirs.

    Args:
        settings: as they are.
        parameters: of these and of other settings.
        prefix: of the parameters' names.
        before: the name of a parameter in the sentence of an error.
    """
    values = {each.name: each.value for each in parameters}
    changes = {
        name: to_setting_value(kind, values[prefix + name])
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
    """List settings as parameters."""
    return [Parameter(name, value=_raw(settings, name)) for name in rules_of(type(settings))]


def _raw(settings: Settings, name: str) -> Any:
    return to_parameter_value(kinds_of(type(settings))[name], getattr(settings, name))


def _descriptor(settings: Settings, name: str) -> ParameterDescriptor:
    """Describe a setting for `ros2 param describe`.

    ``additional_constraints`` is a JSON object: ``unit`` (SI), ``shown_in`` (the unit on a dial),
    ``choices`` (their meanings by name), ``none`` (the value that stands for none), ``live`` (true
    if it may change while the node runs).
    """
    rule, kind = rules_of(type(settings))[name], kinds_of(type(settings))[name]
    live = is_live(type(settings), name)
    more: dict[str, Any] = {"live": live}
    if rule.quantity and rule.quantity.unit:
        more |= {"unit": rule.quantity.unit, "shown_in": choose_dial_unit(rule.quantity)}
    meanings = rule.choice.summaries if rule.choice else {}
    if names := rule.choice.names if rule.choice else rule.choices:
        more["choices"] = {each: meanings.get(each, "") for each in names}
    if may_be_none(kind):
        more["none"] = "" if str in get_args(kind) else 0
    descriptor = ParameterDescriptor(
        description=rule.description,
        additional_constraints=json.dumps(more, ensure_ascii=False),
        read_only=not live,
        dynamic_typing=kind is str and not live,
    )
    if rule.quantity is not None:  # ROS has no range for lists
        low, high = rule.quantity.minimum, settings.get_upper_limit(name)
        kinds = get_args(kind) if may_be_none(kind) else (kind,)
        low = min(low, 0.0) if may_be_none(kind) else low
        if float in kinds:
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
        elif int in kinds:
            whole = IntegerRange(from_value=int(low), to_value=int(high), step=1)
            descriptor.integer_range = [whole]
    return descriptor
