"""A node of this package made in this process, in place of one of its own."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

from us_sim.errors import UsSimError
from us_sim.run.parameter_texts import require_texts
from us_sim.run.running_node import module_of


def node_in_process(name: str, parameters: Mapping[str, object], context: Any) -> Any:
    """The node called ``name`` in an initialised context, with parameters by name.

    Raises:
        UsSimError: a parameter is refused, or what the node itself refuses.
    """
    import us_sim.nodes  # noqa: F401, I001 - provides rclpy where ROS 2 is not installed
    from rclpy.exceptions import ParameterException
    from rclpy.parameter import Parameter

    require_texts(parameters)
    kind = "".join(word.capitalize() for word in name.split("_"))
    make = getattr(importlib.import_module(module_of(name)), kind)
    overrides = [Parameter(key, value=value) for key, value in parameters.items()]
    try:
        return make(context=context, parameter_overrides=overrides)
    except ParameterException as error:
        raise UsSimError(" ".join(str(error).split())) from error
