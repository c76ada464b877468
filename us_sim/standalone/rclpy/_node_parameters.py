"""The parameters of a node: declaring, getting and setting them, and the callbacks that check."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

from ..messages import message_class
from .endpoints import Publisher
from .exceptions import (
    InvalidParameterException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterAlreadyDeclaredException,
    ParameterImmutableException,
    ParameterNotDeclaredException,
    ParameterUninitializedException,
)
from .parameter import PARAMETER_SEPARATOR_STRING, Parameter, reason_against
from .time import ROSClock

ParameterDescriptor: Any = message_class("rcl_interfaces/msg/ParameterDescriptor")
ParameterValue: Any = message_class("rcl_interfaces/msg/ParameterValue")
ParameterMsg: Any = message_class("rcl_interfaces/msg/Parameter")
ParameterEvent: Any = message_class("rcl_interfaces/msg/ParameterEvent")
SetParametersResult: Any = message_class("rcl_interfaces/msg/SetParametersResult")
ListParametersResult: Any = message_class("rcl_interfaces/msg/ListParametersResult")

NOT_SET = Parameter.Type.NOT_SET
_RECURSIVE = 0  # ListParameters.Request.DEPTH_RECURSIVE


class NodeParameters:
    """A node's parameters by name, which have to be declared before they are used."""

    PARAM_REL_TOL = 1e-06

    _clock: ROSClock
    _rcl_name: str
    _rcl_namespace: str
    _parameter_event_publisher: Publisher | None

    def get_fully_qualified_name(self) -> str:
        return f"{self._rcl_namespace.rstrip('/')}/{self._rcl_name}"

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

    def declare_parameter(
        self, name: str, value: Any = None, descriptor: Any = None, ignore_override: bool = False
    ) -> Parameter:
        """Make a parameter known.

        Raises:
            ParameterAlreadyDeclaredException, InvalidParameterException: the name is taken, or
                not allowed.
            InvalidParameterTypeException, InvalidParameterValueException: the value is of another
                type than the default, out of range, or refused by a callback.
        """
        parameter: tuple[Any, ...] = (name,)
        if value is not None or descriptor is not None:
            parameter = (name, value, ParameterDescriptor() if descriptor is None else descriptor)
        return self.declare_parameters("", [parameter], ignore_override)[0]

    def declare_parameters(
        self, namespace: str, parameters: Sequence[tuple[Any, ...]], ignore_override: bool = False
    ) -> list[Parameter]:
        """Make several parameters known; raises as `declare_parameter`."""
        values: list[Parameter] = []
        descriptors: dict[str, Any] = {}
        for index, declaration in enumerate(parameters):
            name, value, descriptor = self._rcl_read_declaration(namespace, index, declaration)
            if not ignore_override and name in self._parameter_overrides:
                value = self._parameter_overrides[name].value
            values.append(Parameter(name, value=value))
            descriptors[name] = descriptor
        declared = [parameter.name for parameter in values if parameter.name in self._parameters]
        if declared:
            raise ParameterAlreadyDeclaredException(declared)
        for parameter in values:
            descriptor = descriptors[parameter.name]
            expected = Parameter.Type(descriptor.type)
            if not descriptor.dynamic_typing and parameter.type_ not in (expected, NOT_SET):
                raise InvalidParameterTypeException(parameter, expected.name)
            result = self._rcl_set_all([parameter], descriptors)
            if not result.successful:
                raise InvalidParameterValueException(parameter.name, parameter.value, result.reason)
        return [self._parameters[parameter.name] for parameter in values]

    def _rcl_read_declaration(
        self, namespace: str, index: int, declaration: tuple[Any, ...]
    ) -> tuple[str, Any, Any]:
        """Full name, default and completed descriptor of one declaration."""
        if not 1 <= len(declaration) <= 3:
            raise TypeError(
                f"Invalid parameter tuple length at index {index} in parameters list: "
                f"{declaration}; expecting length between 1 and 3"
            )
        name, second, descriptor = (*declaration, None, None)[:3]
        if not isinstance(name, str):
            raise TypeError(
                f"First element {name} at index {index} in parameters list is not a str."
            )
        if namespace:
            name = f"{namespace}.{name}"
        if not name:
            raise InvalidParameterException(name)
        if len(declaration) < 3:
            descriptor = ParameterDescriptor()
        if not isinstance(descriptor, ParameterDescriptor):
            raise TypeError(
                f"Third element {descriptor} at index {index} in parameters list "
                "is not a ParameterDescriptor."
            )
        if len(declaration) == 1:
            warnings.warn(
                f"when declaring parameter named '{name}', declaring a parameter only providing "
                "its name is deprecated. You have to either:\n"
                "\t- Pass a name and a default value different to 'PARAMETER NOT SET' "
                "(and optionally a descriptor).\n"
                "\t- Pass a name and a parameter type.\n"
                "\t- Pass a name and a descriptor with `dynamic_typing=True",
                stacklevel=4,
            )
            descriptor.dynamic_typing = True
        if isinstance(second, Parameter.Type):
            if second is NOT_SET:
                raise ValueError(
                    f"Cannot declare parameter {{{name}}} as statically typed of type NOT_SET"
                )
            if descriptor.dynamic_typing:
                raise ValueError(
                    f"When declaring parameter {{{name}}} passing a descriptor with"
                    "`dynamic_typing=True` is not allowed when the parameter type is provided"
                )
            descriptor.type = second.value
            return name, None, descriptor
        if isinstance(second, ParameterValue):
            second = Parameter.from_parameter_msg(ParameterMsg(name=name, value=second)).value
        if not descriptor.dynamic_typing:
            descriptor.type = Parameter.Type.from_parameter_value(second).value
            if descriptor.type == 0:
                raise ValueError(
                    "Cannot declare a statically typed parameter with default value "
                    "of type PARAMETER_NOT_SET"
                )
        return name, second, descriptor

    def undeclare_parameter(self, name: str) -> None:
        if name not in self._parameters:
            raise ParameterNotDeclaredException(name)
        if self._descriptors[name].read_only:
            raise ParameterImmutableException(name)
        del self._parameters[name]
        del self._descriptors[name]

    def describe_parameter(self, name: str) -> Any:
        if name in self._descriptors:
            return self._descriptors[name]
        if self._allow_undeclared_parameters:
            return ParameterDescriptor()
        raise ParameterNotDeclaredException(name)

    def describe_parameters(self, names: list[str]) -> list[Any]:
        return [self.describe_parameter(name) for name in names]

    def has_parameter(self, name: str) -> bool:
        return name in self._parameters

    def get_parameter_types(self, names: list[str]) -> list[Parameter.Type]:
        _require_strings(names)
        return [self.get_parameter_type(name) for name in names]

    def get_parameter_type(self, name: str) -> Parameter.Type:
        """The type of a parameter as the number of a Parameter.Type."""
        if name in self._parameters:
            return self._parameters[name].type_.value
        if self._allow_undeclared_parameters:
            return NOT_SET
        raise ParameterNotDeclaredException(name)

    def get_parameters(self, names: list[str]) -> list[Parameter]:
        _require_strings(names)
        return [self.get_parameter(name) for name in names]

    def get_parameter(self, name: str) -> Parameter:
        """A parameter; raises ParameterUninitializedException when it has a type and no value."""
        parameter = self._parameters.get(name)
        if parameter is not None:
            if parameter.type_ is NOT_SET and not (self._descriptors[name].dynamic_typing):
                raise ParameterUninitializedException(name)
            return parameter
        if self._allow_undeclared_parameters:
            return Parameter(name, NOT_SET, None)
        raise ParameterNotDeclaredException(name)

    def get_parameter_or(self, name: str, alternative_value: Parameter | None = None) -> Parameter:
        """A parameter, or the alternative when it is not known or has no value."""
        parameter = self._parameters.get(name)
        if parameter is not None and parameter.type_ is not NOT_SET:
            return parameter
        return Parameter(name) if alternative_value is None else alternative_value

    def get_parameters_by_prefix(self, prefix: str) -> dict[str, Any]:
        """The parameters whose names begin with a prefix and a dot, by the rest of their names."""
        start = f"{prefix}{PARAMETER_SEPARATOR_STRING}" if prefix else ""
        return {
            name[len(start) :]: parameter
            for name, parameter in self._parameters.items()
            if name.startswith(start)
        }

    def list_parameters(self, prefixes: list[str], depth: int) -> Any:
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
        """Set parameters one after the other; a `SetParametersResult` for each."""
        return [self.set_parameters_atomically([parameter]) for parameter in parameter_list]

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> Any:
        """Set all parameters or none."""
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
        return self._rcl_set_all(parameter_list)

    def _rcl_set_all(
        self, parameters: list[Parameter], descriptors: dict[str, Any] | None = None
    ) -> Any:
        """Check, ask the callbacks, set, and tell everybody; `descriptors` come with declaring."""
        for parameter in parameters:
            reason = self._rcl_reason_against(parameter, descriptors)
            if reason:
                return SetParametersResult(successful=False, reason=reason)
        for callback in self._on_set_parameters_callbacks:
            result = callback(parameters)
            if not result.successful:
                return result
        event = ParameterEvent(node=self.get_fully_qualified_name())
        for parameter in parameters:
            name, is_new = parameter.name, self.get_parameter_or(parameter.name).type_ is NOT_SET
            changes = event.new_parameters if is_new else event.changed_parameters
            if descriptors is None and parameter.type_ is NOT_SET:
                self._parameters.pop(name, None)
                self._descriptors.pop(name, None)
                changes = event.deleted_parameters
            else:
                self._parameters[name] = parameter
                if descriptors is not None:
                    self._descriptors[name] = descriptors[name]
                elif name not in self._descriptors:
                    self._descriptors[name] = ParameterDescriptor(name=name, dynamic_typing=True)
            changes.append(parameter.to_parameter_msg())
        event.stamp = self._clock.now().to_msg()
        if self._parameter_event_publisher is not None:
            self._parameter_event_publisher.publish(event)
        for callback in self._post_set_parameters_callbacks:
            callback(parameters)
        return SetParametersResult(successful=True)

    def _rcl_reason_against(self, parameter: Parameter, descriptors: dict[str, Any] | None) -> str:
        """The reason why a descriptor forbids a value, or ""; completes the descriptor."""
        descriptor = (descriptors or self._descriptors).get(parameter.name)
        if descriptor is None:
            return ""
        descriptor.name = parameter.name
        if descriptors is None and descriptor.read_only:
            return f"Trying to set a read-only parameter: {parameter.name}."
        not_set = parameter.type_ is NOT_SET
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
        self._pre_set_parameters_callbacks.remove(callback)

    def remove_on_set_parameters_callback(self, callback: Callable[..., Any]) -> None:
        self._on_set_parameters_callbacks.remove(callback)

    def remove_post_set_parameters_callback(self, callback: Callable[..., Any]) -> None:
        self._post_set_parameters_callbacks.remove(callback)


def _require_strings(names: list[str]) -> None:
    if not all(isinstance(name, str) for name in names):
        raise TypeError("All names must be instances of type str")
