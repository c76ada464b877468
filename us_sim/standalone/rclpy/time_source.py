"""Simulated time for a node: while its parameter `use_sim_time` is true, /clock sets its clock."""

import weakref
from typing import Any

from ..messages import message_class
from .clock import ROSClock
from .parameter import Parameter
from .qos import QoSProfile, ReliabilityPolicy
from .time import Time

_PARAMETER = "use_sim_time"


class TimeSource:
    """Sets a node's clock from the topic /clock; declares the parameter if need be."""

    def __init__(self, node: Any, clock: ROSClock) -> None:
        self._node: weakref.ReferenceType[Any] = weakref.ref(node)
        self._clock = clock
        self._subscription: Any = None
        if not node.has_parameter(_PARAMETER):
            node.declare_parameter(_PARAMETER, False)
        parameter = node.get_parameter(_PARAMETER)
        if parameter.type_ is Parameter.Type.BOOL:
            self._follow(parameter.value)
        else:
            node.get_logger().error(
                f"Invalid type for parameter '{_PARAMETER}' {parameter.type_!r} should be bool"
            )
        node.add_on_set_parameters_callback(self._on_set_parameters)

    def _follow(self, enabled: bool) -> None:
        if self._clock.ros_time_is_active == enabled:
            return
        self._clock._set_ros_time_is_active(enabled)
        node = self._node()
        if node is None:
            return
        if enabled:
            self._subscription = node.create_subscription(
                message_class("rosgraph_msgs/msg/Clock"),
                "/clock",
                lambda message: self._clock.set_ros_time_override(Time.from_msg(message.clock)),
                QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT),
            )
        else:
            node.destroy_subscription(self._subscription)

    def _on_set_parameters(self, parameters: list[Parameter]) -> Any:
        result: Any = message_class("rcl_interfaces/msg/SetParametersResult")(successful=True)
        for parameter in parameters:
            if parameter.name == _PARAMETER:
                if parameter.type_ is Parameter.Type.BOOL:
                    self._follow(parameter.value)
                else:
                    result.successful = False
                    result.reason = f"{_PARAMETER} parameter set to something besides a bool"
        return result
