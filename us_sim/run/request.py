"""What a live run is asked for: a scene, what is recorded and played, and where it is shown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from us_sim.run.graph import RECORDER, VIEWER, Parameters
from us_sim.scene.scene import Scene
from us_sim.settings.viewer import ViewerSettings

if TYPE_CHECKING:
    from us_sim.demo.camera_video import PathVideo

_OF_ANY_SCENE = (VIEWER, RECORDER, "path_player")
"""Nodes whose parameters hold whatever the scene is."""


@dataclass(frozen=True)
class Request:
    """What a live run is asked for."""

    scene: Scene
    parameters: Parameters = field(default_factory=dict)  # given by a person, by node
    record: Path | None = None  # MCAP file to record to
    path: Path | None = None  # bag to play to the tracker
    topic: str | None = None  # of the body in it whose poses are played
    everything: bool = False  # the bag's topics are published in place of the scene's nodes
    playing: Mapping[str, object] = field(default_factory=dict)  # parameters of what plays it
    video: PathVideo | None = None  # to show the scene's camera in place of a path
    view: ViewerSettings | None = None  # address of the page that shows it; None is no page
    by_hand: bool = False  # poses come on `tracker/pose`, whatever the scene's tracker is
    duration: float | None = None  # s, after which all ends
    kept: Mapping[str, Mapping[str, object]] = field(default_factory=dict)  # set as nodes ran
    is_changed: bool = False  # while it ran: parameters may be of nodes that do not run now

    def with_scene(self, scene: Scene) -> Request:
        """Another scene: nothing is recorded or played in it yet.

        Parameters of the scene's nodes were given for the scene before.
        """
        kept = {node: given for node, given in self.parameters.items() if node in _OF_ANY_SCENE}
        return replace(self.without_replay(), scene=scene, parameters=kept, record=None)

    def without_replay(self) -> Request:
        """Nothing is played."""
        return replace(self, path=None, topic=None, everything=False, playing={}, is_changed=True)
