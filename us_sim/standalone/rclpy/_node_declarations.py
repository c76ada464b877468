"""What the parameters of a node are: declaring, undeclaring and describing them."""

import warnings
from collections.abc import Sequence
from typing import Any

from ..messages import message_class
from ._node_parameters import NodeParameters
from .exceptions import (
    InvalidParameterException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterAlreadyDeclaredException,
    ParameterImmutableException,
    ParameterNotDeclaredException,
)
from .parameter import Parameter

__all__ = ["NodeDeclarations"]

ParameterDescriptor: Any = message_class("rcl_interfaces/msg/ParameterDescriptor")
ParameterValue: Any = message_class("rcl_interfaces/msg/ParameterValue")
ParameterMsg: Any = message_class("rcl_interfaces/msg/Parameter")


class NodeDeclarations(NodeParameters):
    """Parameters that have to be declared before they are used."""

    def declare_parameter(
        self,
        name: str,
        value: Any = None,
        descriptor: Any = None,
        ignore_override: bool = False,
    ) -> Parameter:
        """Make a parameter known.

        Args:
            name: without the node's name; dots group parameters.
            value: default, or a Parameter.Type when the value has to come from outside.
            descriptor: a `rcl_interfaces/msg/ParameterDescriptor`.
            ignore_override: whether the default holds even if another value was given outside.

        Returns:
            The parameter with the value that holds now.

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
        self,
        namespace: str,
        parameters: Sequence[tuple[Any, ...]],
        ignore_override: bool = False,
    ) -> list[Parameter]:
        """Make several parameters known; raises as `declare_parameter`.

        Args:
            namespace: put before each name, with a dot.
            parameters: name; name and default or type; or name, default or type, and descriptor.
            ignore_override: whether defaults hold even if other values were given outside.
        """
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
            result = self._rcl_set_all([parameter], descriptors, declaring=True)
            if not result.successful:
                if result.reason.startswith("Wrong parameter type"):
                    raise InvalidParameterTypeException(
                        parameter, Parameter.Type(descriptors[parameter.name].type).name
                    )
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
            if second is Parameter.Type.NOT_SET:
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
        """Forget a parameter.

        Raises:
            ParameterNotDeclaredException: it is not known.
            ParameterImmutableException: it is read-only.
        """
        if name not in self._parameters:
            raise ParameterNotDeclaredException(name)
        if self._descriptors[name].read_only:
            raise ParameterImmutableException(name)
        del self._parameters[name]
        del self._descriptors[name]

    def describe_parameter(self, name: str) -> Any:
        """The `rcl_interfaces/msg/ParameterDescriptor` of a parameter.

        Raises:
            ParameterNotDeclaredException: it is not known.
        """
        if name in self._descriptors:
            return self._descriptors[name]
        if self._allow_undeclared_parameters:
            return ParameterDescriptor()
        raise ParameterNotDeclaredException(name)

    def describe_parameters(self, names: list[str]) -> list[Any]:
        """The descriptors of several parameters; raises as `describe_parameter`."""
        return [self.describe_parameter(name) for name in names]
