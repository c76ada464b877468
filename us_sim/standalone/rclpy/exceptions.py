"""The errors that rclpy raises, with the sentences that rclpy writes."""

from typing import Any


class RCLError(RuntimeError):
    """An operation on a node, an endpoint or a context failed."""


class RCLInvalidROSArgsError(RCLError):
    """An argument after --ros-args is malformed."""


class UnknownROSArgsError(RuntimeError):
    """An argument after --ros-args is none that ROS knows."""


class InvalidHandle(RuntimeError):
    """Something that was destroyed is used."""


class Destroyable:
    """Something that exists until `destroy`."""

    _destroyed = False

    def destroy(self) -> None:
        """End its existence; a second time does nothing."""
        self._destroyed = True

    def _require_existence(self) -> None:
        if self._destroyed:
            raise InvalidHandle("cannot use Destroyable because destruction was requested")


class NotInitializedException(Exception):
    def __init__(self, message: str | None = None) -> None:
        sentence = "rclpy.init() has not been called."
        super().__init__(f"{sentence} msg:{message}" if message else sentence)


class NoTypeSupportImportedException(Exception):
    def __init__(self) -> None:
        super().__init__("no type_support imported")


class NameValidationException(Exception):
    _kind = "name"

    def __init__(self, name: str, error_msg: str, invalid_index: int) -> None:
        pointer = " " * invalid_index + "^"
        super().__init__(f"Invalid {self._kind}: {error_msg}:\n  '{name}'\n   {pointer}")


class InvalidNamespaceException(NameValidationException):
    _kind = "namespace"


class InvalidNodeNameException(NameValidationException):
    _kind = "node name"


class InvalidTopicNameException(NameValidationException):
    _kind = "topic name"


class InvalidServiceNameException(NameValidationException):
    _kind = "service name"


class ParameterException(Exception):
    def __init__(self, error_msg: str, parameters: str | list[str]) -> None:
        super().__init__(f"{error_msg}: {parameters}")


class ParameterNotDeclaredException(ParameterException):
    def __init__(self, parameters: str | list[str]) -> None:
        super().__init__("Invalid access to undeclared parameter(s)", parameters)


class ParameterAlreadyDeclaredException(ParameterException):
    def __init__(self, parameters: str | list[str]) -> None:
        super().__init__("Parameter(s) already declared", parameters)


class InvalidParameterException(ParameterException):
    def __init__(self, parameter_name: str):
        super().__init__("Invalid parameter name", parameter_name)


class InvalidParameterTypeException(ParameterException):
    def __init__(self, desired_parameter: Any, expected_type: Any) -> None:
        super().__init__(
            f"Trying to set parameter '{desired_parameter.name}' to '{desired_parameter.value}'"
            f" of type '{desired_parameter.type_.name}', expecting type '{expected_type}'",
            desired_parameter.name,
        )


class InvalidParameterValueException(ParameterException):
    def __init__(self, parameter: str, value: Any, reason: str) -> None:
        super().__init__(
            f"Invalid parameter value ({value}) for parameter. Reason: {reason}", parameter
        )


class ParameterImmutableException(ParameterException):
    def __init__(self, parameter_name: str):
        super().__init__("Attempted to modify read-only parameter", parameter_name)


class ParameterUninitializedException(ParameterException):
    """A parameter is read that was declared with a type but has no value yet."""

    def __init__(self, parameter_name: str):
        super().__init__(f"The parameter '{parameter_name}' is not initialized", parameter_name)
