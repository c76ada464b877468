"""Control of a running simulation: parameters by which scenes are loaded, recorded, replayed."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cache, partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from std_msgs.msg import Header

from us_sim.errors import UsSimError
from us_sim.nodes.guarded_node import GuardedNode, Health, status_message
from us_sim.nodes.parameters import declare_settings, parameters_with, settings_with
from us_sim.nodes.settings import SessionControlSettings
from us_sim.scene.listing import ListedScene

_FLOWING = ("position", "fraction", "record_seconds", "record_bytes", "record_room_bytes")
"""Values that change all the time, and are published once a second."""

Use = Callable[[SessionControlSettings, Collection[str]], None]
"""Called with the settings and the names of the parameters that were set."""


class SessionControl(GuardedNode):
    """A simulation's switches, for any machine on its ROS domain.

    Its parameters are those of `SessionControlSettings`. The progress of a change is in its report
    on ``diagnostics``: `state`, and `fraction` while something is loaded.

    Args:
        check: raises a UsSimError for settings that cannot be.
        take: begins to do what settings say; parameters that were not set stay in force.
        settings: that are in force now.
    """

    def __init__(
        self, check: Use, take: Use, settings: SessionControlSettings, **kwargs: Any
    ) -> None:
        super().__init__("session_control", **kwargs)
        self._check_wanted, self._take_wanted = check, take
        self.values = declare_settings(self, SessionControlSettings())
        self._is_showing = False  # the parameters are being set to the present state
        self._reported: tuple[object, ...] = ()
        self._player = cache(partial(AsyncParameterClient, self))
        self._unsent: dict[str, dict[str, Any]] = {}  # parameters for a node that plays
        self.health = Health(self, "")
        self._scenes = self.create_latched_publisher(DiagnosticArray, "session/scenes")
        self._bags = self.create_latched_publisher(DiagnosticArray, "session/bags")
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self.set_state_parameters(settings)

    def set_state_parameters(self, settings: SessionControlSettings) -> None:
        """Set the parameters to the present state."""
        self._is_showing = True
        try:
            self.set_parameters_atomically(parameters_with(settings))
        finally:
            self._is_showing = False

    def publish_state(self, state: str, values: Mapping[str, str], warning: str = "") -> None:
        """Report the state; at once if more than a time or a size has changed."""
        news = state, warning, {key: values[key] for key in values if key not in _FLOWING}
        is_news, self._reported = news != self._reported, news
        self.health.state, self.health.warning = state, warning
        self.health.values = dict(values)
        self._hand_on()
        if is_news:
            self.health.publish_report()

    def set_player_parameters(self, node: str, values: Mapping[str, Any]) -> None:
        """Set parameters of the node that plays, as soon as it is there."""
        self._unsent = {node: self._unsent.get(node, {}) | dict(values)}
        self._hand_on()

    def _hand_on(self) -> None:
        for node in [each for each in self._unsent if self._player(each).services_are_ready()]:
            values = self._unsent.pop(node)
            parameters = [Parameter(name, value=each) for name, each in values.items()]
            self._player(node).set_parameters(parameters)

    @property
    def is_list_wanted(self) -> bool:
        """True if somebody subscribes to the list of scenes."""
        return self._scenes.get_subscription_count() > 0

    def publish_scenes(self, scenes: Sequence[ListedScene]) -> None:
        """Publish the scenes and cases that can be loaded."""
        message = DiagnosticArray(header=Header(stamp=self.get_clock().now().to_msg()))
        for scene in scenes:
            about = {
                "kind": scene.kind,
                "region": scene.region,
                "structures": json.dumps(scene.structures),
                "probe": scene.probe,
                "tracker": scene.tracker,
            }
            level = DiagnosticStatus.ERROR if scene.problem else DiagnosticStatus.OK
            text = scene.problem or scene.description
            message.status.append(status_message(scene.name, text, about, scene.origin, level))
        self._scenes.publish(message)

    def publish_bags(self, bags: Mapping[str, str]) -> None:
        """Publish the bags that can be played: files by name."""
        message = DiagnosticArray(header=Header(stamp=self.get_clock().now().to_msg()))
        message.status = [
            DiagnosticStatus(name=name, hardware_id=file, message="bag")
            for name, file in bags.items()
        ]
        self._bags.publish(message)

    def _wanted(self, parameters: list[Parameter]) -> SessionControlSettings:
        """Return the settings with new parameters; another scene loses the volume of the last."""
        names = {each.name for each in parameters}
        if "scene" in names and "volume" not in names:
            parameters = [*parameters, Parameter("volume", value="")]
        return settings_with(self.values, parameters)

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        if self._is_showing:
            return SetParametersResult(successful=True)
        try:
            wanted = self._wanted(parameters)
            self._check_wanted(wanted, {each.name for each in parameters})
        except UsSimError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        if self._is_showing:
            self.values = settings_with(self.values, parameters)
            return
        self.values = self._wanted(parameters)
        self.set_state_parameters(self.values)
        self._take_wanted(self.values, {each.name for each in parameters})
