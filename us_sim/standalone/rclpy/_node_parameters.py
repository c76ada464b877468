"""The parameters of a node: getting, listing and setting them, and who has a say in it."""

from collections.abc import Callable
from typing import Any

from ..messages import message_class
from ._parameter_ranges import reason_against
from .clock import ROSClock
from .exceptions import ParameterNotDeclaredException, ParameterUninitializedException
from .parameter import PARAMETER_SEPARATOR_STRING, Parameter
from .publisher import Publisher

__all__ = ["NodeParameters"]

ParameterDescriptor: Any = message_class("rcl_interfaces/msg/ParameterDescriptor")
ParameterEvent: Any = message_class("rcl_interfaces/msg/ParameterEvent")
SetParametersResult: Any = message_class("rcl_interfaces/msg/SetParametersResult")
ListParametersResult: Any = message_class("rcl_interfaces/msg/ListParametersResult")

_RECURSIVE = 0  # ListParameters.Request.DEPTH_RECURSIVE


class NodeParameters:
    """A node's parameters by name; `Node` publishes the events."""

    PARAM_REL_TOL = 1e-06

    _clock: ROSClock
    _parameter_event_publisher: Publisher | None

    def _rcl_keep_parameters(
        self, overrides: dict[str, Parameter], allow_undeclared_parameters: bool
    ) -> None:
        self._parameters: dict[str, Parameter] = {}
        self._descriptors: dict[str, Any] = {}
        self._parameter_overrides = overrides
        self._allow_undeclared_parameters = allow_undeclared_parameters
        self._pre_set_parameters_callbacks: list[Callable[..., Any]] = []
        self._on_set_parameters_callbacks: list[Callable[..., Any]] = []
        self._post_set_parameters_callbacks: list[Callable[..., Any]] = []

    def get_fully_qualified_name(self) -> str:
        """This node's absolute name."""
        raise NotImplementedError

    def has_parameter(self, name: str) -> bool:
        """Whether a parameter is known."""
        return name in self._parameters

    def get_parameter_types(self, names: list[str]) -> list[Parameter.Type]:
        """The types of several parameters; raises as `get_parameter_type`."""
        _require_strings(names)
        return [self.get_parameter_type(name) for name in names]

    def get_parameter_type(self, name: str) -> Parameter.Type:
        """The type of a parameter as the number of a Parameter.Type.

        Raises:
            ParameterNotDeclaredException: it is not known.
        """
        if name in self._parameters:
            return self._parameters[name].type_.value
        if self._allow_undeclared_parameters:
            return Parameter.Type.NOT_SET
        raise ParameterNotDeclaredException(name)

    def get_parameters(self, names: list[str]) -> list[Parameter]:
        """Several parameters; raises as `get_parameter`."""
        _require_strings(names)
        return [self.get_parameter(name) for name in names]

    def get_parameter(self, name: str) -> Parameter:
        """A parameter.

        Raises:
            ParameterNotDeclaredException: it is not known.
            ParameterUninitializedException: it was declared with a type and has no value yet.
        """
        parameter = self._parameters.get(name)
        if parameter is not None:
            if parameter.type_ is Parameter.Type.NOT_SET and not (
                self._descriptors[name].dynamic_typing
            ):
                raise ParameterUninitializedException(name)
            return parameter
        if self._allow_undeclared_parameters:
            return Parameter(name, Parameter.Type.NOT_SET, None)
        raise ParameterNotDeclaredException(name)

    def get_parameter_or(self, name: str, alternative_value: Parameter | None = None) -> Parameter:
        """A parameter, or the alternative when it is not known or has no value."""
        parameter = self._parameters.get(name)
        if parameter is not None and parameter.type_ is not Parameter.Type.NOT_SET:
            return parameter
        if alternative_value is None:
            return Parameter(name, Parameter.Type.NOT_SET)
        return alternative_value

    def get_parameters_by_prefix(self, prefix: str) -> dict[str, Any]:
        """The parameters whose names begin with a prefix and a dot, by the rest of their names."""
        start = f"{prefix}{PARAMETER_SEPARATOR_STRING}" if prefix else ""
        return {
            name[len(start) :]: parameter
            for name, parameter in self._parameters.items()
            if name.startswith(start)
        }

    def list_parameters(self, prefixes: list[str], depth: int) -> Any:
        """The names of parameters, as a `rcl_interfaces/msg/ListParametersResult`.

        Args:
            prefixes: only names that are one of these or begin with one and a dot; [] for all.
            depth: how many more parts names may have; 0 for any number.
        """
        if not isinstance(prefixes, list):
            raise TypeError("The prefixes argument must be a list")
        if not all(isinstance(prefix, str) for prefix in prefixes):
            raise TypeError("All prefixes must be instances of type str")
        if not isinstance(depth, int):
            raise TypeError("The depth must be instance of type int")
        if depth < 0:
            raise ValueError("The depth must be greater than or equal to zero")

        def is_shallow(rest: str) -> bool:
            return depth == _RECURSIVE or rest.count(PARAMETER_SEPARATOR_STRING) < depth

        def is_wanted(name: str) -> bool:
            if not prefixes:
                return is_shallow(name)
            return any(
                name == prefix
                or (
                    name.startswith(prefix + PARAMETER_SEPARATOR_STRING)
                    and is_shallow(name[len(prefix) + 1 :])
                )
                for prefix in prefixes
            )

        names = [name for name in self._parameters if is_wanted(name)]
        groups = dict.fromkeys(name.rpartition(".")[0] for name in names if "." in name)
        return ListParametersResult(names=names, prefixes=list(groups))

    def set_parameters(self, parameter_list: list[Parameter]) -> list[Any]:
        """Set parameters one after the other.

        Returns:
            A `rcl_interfaces/msg/SetParametersResult` for each.

        Raises:
            ParameterNotDeclaredException: one is not known.
        """
        return [self.set_parameters_atomically([parameter]) for parameter in parameter_list]

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> Any:
        """Set all parameters or none; raises and returns as `set_parameters`."""
        if self._pre_set_parameters_callbacks:
            parameter_list = [
                parameter
                for callback in self._pre_set_parameters_callbacks
                for parameter in callback(parameter_list)
            ]
            if not parameter_list:
                return SetParametersResult(
                    successful=False,
                    reason="parameter list cannot be empty, this might be due to "
                    "pre_set_parameters_callback modifying the original parameters list.",
                )
        if not all(isinstance(parameter, Parameter) for parameter in parameter_list):
            raise TypeError(f"parameter must be instance of type '{Parameter!r}'")
        unknown = [p.name for p in parameter_list if p.name not in self._parameters]
        if unknown and not self._allow_undeclared_parameters:
            raise ParameterNotDeclaredException(unknown)
        return self._rcl_set_all(parameter_list, None, declaring=False)

    def _rcl_set_all(
        self, parameters: list[Parameter], descriptors: dict[str, Any] | None, declaring: bool
    ) -> Any:
        """Check, ask the callbacks, set, and tell everybody; `descriptors` come with declaring."""
        for parameter in parameters:
            descriptor = (self._descriptors if descriptors is None else descriptors).get(
                parameter.name
            )
            reason = (
                ""
                if descriptor is None
                else self._rcl_reason_against(parameter, descriptor, check_read_only=not declaring)
            )
            if reason:
                return SetParametersResult(successful=False, reason=reason)
        for callback in self._on_set_parameters_callbacks:
            result = callback(parameters)
            if not result.successful:
                return result
        event = ParameterEvent(node=self.get_fully_qualified_name())
        for parameter in parameters:
            changes = self._rcl_set_one(parameter, descriptors, declaring)
            getattr(event, changes).append(parameter.to_parameter_msg())
        event.stamp = self._clock.now().to_msg()
        if self._parameter_event_publisher is not None:
            self._parameter_event_publisher.publish(event)
        for callback in self._post_set_parameters_callbacks:
            callback(parameters)
        return SetParametersResult(successful=True)

    def _rcl_set_one(
        self, parameter: Parameter, descriptors: dict[str, Any] | None, declaring: bool
    ) -> str:
        """Set what was checked; returns which part of a parameter event tells it."""
        name = parameter.name
        if not declaring and parameter.type_ is Parameter.Type.NOT_SET:
            self._parameters.pop(name, None)
            self._descriptors.pop(name, None)
            return "deleted_parameters"
        if descriptors is not None:
            self._descriptors[name] = descriptors[name]
        elif name not in self._descriptors:
            self._descriptors[name] = ParameterDescriptor(name=name, dynamic_typing=True)
        is_new = self.get_parameter_or(name).type_ is Parameter.Type.NOT_SET
        self._parameters[name] = parameter
        return "new_parameters" if is_new else "changed_parameters"

    def _rcl_reason_against(
        self, parameter: Parameter, descriptor: Any, *, check_read_only: bool
    ) -> str:
        """Why a descriptor does not allow a value, '' when it does; completes the descriptor."""
        descriptor.name = parameter.name
        if check_read_only and descriptor.read_only:
            return f"Trying to set a read-only parameter: {parameter.name}."
        not_set = parameter.type_ is Parameter.Type.NOT_SET
        if descriptor.dynamic_typing:
            descriptor.type = parameter.type_.value
        elif not_set and parameter.name in self._parameters:
            return "Static parameter cannot be undeclared"
        elif not not_set and parameter.type_.value != descriptor.type:
            return (
                f"Wrong parameter type, expected '{Parameter.Type(descriptor.type)}' "
                f"got '{parameter.type_}'"
            )
        return reason_against(parameter, descriptor, self.PARAM_REL_TOL)

    def add_pre_set_parameters_callback(self, callback: Callable[..., Any]) -> None:
        """Have a function replace the parameters that are to be set by those it returns."""
        self._pre_set_parameters_callbacks.insert(0, callback)

    def add_on_set_parameters_callback(self, callback: Callable[..., Any]) -> None:
        """Have a function say whether parameters may be set, by a SetParametersResult."""
        self._on_set_parameters_callbacks.insert(0, callback)

    def add_post_set_parameters_callback(self, callback: Callable[..., Any]) -> None:
        """Have a function called after parameters were set."""
        self._post_set_parameters_callbacks.insert(0, callback)

    def remove_pre_set_parameters_callback(self, callback: Callable[..., Any]) -> None:
        """The counterpart of `add_pre_set_parameters_callback`; ValueError when it is not there."""
        self._pre_set_parameters_callbacks.remove(callback)

    def remove_on_set_parameters_callback(self, callback: Callable[..., Any]) -> None:
        """The counterpart of `add_on_set_parameters_callback`; ValueError when it is not there."""
        self._on_set_parameters_callbacks.remove(callback)

    def remove_post_set_parameters_callback(self, callback: Callable[..., Any]) -> None:
        """The counterpart of `add_post_set_parameters_callback`; ValueError when not there."""
        self._post_set_parameters_callbacks.remove(callback)


def _require_strings(names: list[str]) -> None:
    if not all(isinstance(name, str) for name in names):
        raise TypeError("All names must be instances of type str")
