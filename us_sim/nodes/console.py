"""What a sonographer sets at the console, as ROS parameters that may change while the node runs."""

from __future__ import annotations

import dataclasses
from array import array
from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from us_sim.errors import ProbeError, UsSimError
from us_sim.slicing.formation.imaging import Imaging
from us_sim.slicing.probe.probe import Probe

__all__ = ["Console"]

IMAGING = {field.name: field for field in dataclasses.fields(Imaging)}
OF_THE_PROBE = {
    "depth": "m, of the image along the beams from the face",
    "focus": "m along the beams from the face; 0 is the middle of the depth",
}


class Console:
    """Every field of `Imaging`, and the probe's depth and focus, as parameters of the same names.

    Args:
        node: that has the parameters.
        probe, imaging: as the scene has them; the parameters' defaults.
        prepare: called with a probe and settings before they are taken; what it raises refuses
            them.
        use: called with those that ``prepare`` let pass, when the parameters have been set.

    Raises:
        ProbeError: a value given at the start is out of range; the node's name comes first.
    """

    def __init__(
        self,
        node: Node,
        probe: Probe,
        imaging: Imaging,
        prepare: Callable[[Probe, Imaging], None],
        use: Callable[[Probe, Imaging], None],
    ) -> None:
        self._prepare = prepare
        self._use = use
        self.probe, self.imaging = probe, imaging
        given = [
            _declared(node, field, getattr(imaging, name), field.metadata["description"])
            for name, field in IMAGING.items()
        ]
        of_probe = {field.name: field for field in dataclasses.fields(probe)}  # type: ignore[arg-type]
        given += [
            _declared(node, of_probe[name], getattr(probe, name), description)
            for name, description in OF_THE_PROBE.items()
        ]
        try:
            self.probe, self.imaging = self._with(given)
        except ProbeError as error:
            raise ProbeError(f"{node.get_name()}: {error}") from error
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._change)

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            wanted = self._with(parameters)
            if wanted != (self.probe, self.imaging):
                self._prepare(*wanted)
        except UsSimError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _change(self, parameters: list[Parameter]) -> None:
        wanted = self._with(parameters)
        if wanted != (self.probe, self.imaging):
            self.probe, self.imaging = wanted
            self._use(*wanted)

    def _with(self, parameters: list[Parameter]) -> tuple[Probe, Imaging]:
        """The probe and the settings with those of the parameters that are theirs."""
        values: dict[str, Any] = {parameter.name: parameter.value for parameter in parameters}
        of_probe = {name: value for name, value in values.items() if name in OF_THE_PROBE}
        if "focus" in of_probe:
            of_probe["focus"] = of_probe["focus"] or None
        probe: Any = self.probe
        return (
            dataclasses.replace(probe, **of_probe),
            dataclasses.replace(self.imaging, **{k: v for k, v in values.items() if k in IMAGING}),
        )


def _declared(node: Node, field: dataclasses.Field[Any], value: Any, description: str) -> Parameter:
    """The parameter, declared with what `ros2 param describe` says of it."""
    if isinstance(value, tuple):
        value = array("d", value or (0.0,))  # an empty list would have no type
    quantity, choices = field.metadata["quantity"], field.metadata["choices"]
    descriptor = ParameterDescriptor(
        description=f"{description}; may change while running",
        additional_constraints=f"one of {', '.join(choices)}" if choices else "",
    )
    if "float" in str(field.type) and not isinstance(value, array):
        low = 0.0 if field.name == "focus" else quantity.minimum
        bounds = FloatingPointRange(from_value=low, to_value=quantity.maximum)
        descriptor.floating_point_range = [bounds]
    elif field.type == "int":
        low, high = int(quantity.minimum), int(quantity.maximum)
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high, step=1)]
    node.declare_parameter(field.name, 0.0 if value is None else value, descriptor)
    return node.get_parameter(field.name)
