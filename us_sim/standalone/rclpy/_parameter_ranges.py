"""Whether a parameter's value keeps to what its descriptor allows; '' or the reason why not."""

import math
from typing import Any

from .parameter import Parameter


def reason_against(parameter: Parameter, descriptor: Any, tolerance: float) -> str:
    """Why a value is outside its descriptor's range or between its steps.

    Args:
        parameter: the value to be set.
        descriptor: a `rcl_interfaces/msg/ParameterDescriptor`.
        tolerance: relative, for comparing floating-point numbers.
    """
    if parameter.type_ is Parameter.Type.INTEGER and descriptor.integer_range:
        return _against_integers(parameter, descriptor.integer_range[0])
    if parameter.type_ is Parameter.Type.DOUBLE and descriptor.floating_point_range:
        return _against_floats(parameter, descriptor.floating_point_range[0], tolerance)
    return ""


def _against_integers(parameter: Parameter, limits: Any) -> str:
    value = parameter.value
    least, most = sorted((limits.from_value, limits.to_value))
    if value in (least, most):
        return ""
    if not least < value < most:
        return f"Parameter {parameter.name} out of range. Min: {least}, Max: {most}, value: {value}"
    if limits.step and (value - least) % limits.step:
        return (
            f"The parameter value for {parameter.name} is not a valid step. "
            f"Min: {least}, max: {most}, value: {value}, step: {limits.step}"
        )
    return ""


def _against_floats(parameter: Parameter, limits: Any, tolerance: float) -> str:
    value = parameter.value
    least, most = sorted((limits.from_value, limits.to_value))
    if any(math.isclose(value, limit, rel_tol=tolerance) for limit in (least, most)):
        return ""
    if not least < value < most:
        return f"Parameter {parameter.name} out of range Min: {least}, Max: {most}, value: {value}"
    if limits.step:
        nearest = least + round((value - least) / limits.step) * limits.step
        if not math.isclose(nearest, value, rel_tol=tolerance):
            return (
                f"The parameter value for {parameter.name} is not close enough to a valid step. "
                f"Min: {least}, max: {most}, value: {value}, step: {limits.step}"
            )
    return ""
