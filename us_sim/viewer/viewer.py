"""The node ``viewer``: it shows the simulator in a browser, where a person can take the probe."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.parameters import declare_settings
from us_sim.nodes.process import node_main
from us_sim.settings.viewer import TOKEN, ViewerSettings
from us_sim.viewer.access import is_loopback
from us_sim.viewer.feeds import (
    ProbeFeeds,
    RestMeshListener,
    SkinFeeds,
    StructuresFeed,
    TissueFeeds,
    make_image_feeds,
)
from us_sim.viewer.hand import ViewerHand
from us_sim.viewer.parameters import Parameter, format_name
from us_sim.viewer.remote_parameters import RemoteParameters
from us_sim.viewer.score import connect_scorer
from us_sim.viewer.server import WebServer
from us_sim.viewer.session import CONTROL, ViewerSession
from us_sim.viewer.status import StatusListener
from us_sim.viewer.stream import CallPoster, PageSources

_IMAGED_WITH = ("gain", "dynamic_range", "focus")
"""Parameters of ``slice_interpolator`` in the header of each image."""


class Viewer(GuardedNode):
    """A web server, and a node that subscribes only to topics that a page shows."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("viewer", **kwargs)
        settings = declare_settings(self, ViewerSettings())
        self.health = Health(self, f"{settings.host}:{settings.port}")
        post = CallPoster(self)
        folder = os.path.abspath(os.path.expanduser(settings.recordings or ""))
        self._session = ViewerSession(
            self, post, folder if settings.recordings else "", is_own=is_loopback(settings.host)
        )
        self._remote = RemoteParameters(self, {CONTROL: self._session.ask_control})
        self.sources = PageSources(
            nodes=self._remote, status=StatusListener(self, post), session=self._session
        )
        connect_scorer(self, post, self.sources)
        rest = RestMeshListener(self)
        self._hand = ViewerHand(self, post, self.sources, rest)
        self._probe = ProbeFeeds(self, post, settings.rate)
        structures = StructuresFeed(self, post, rest)
        self._session.on_other_scene = structures.forget_structures
        self.sources.add_feeds(
            *make_image_feeds(self, post, settings.rate, self._describe, self._read_arrangement),
            *SkinFeeds(self, post, settings.rate).feeds,
            *self._probe.feeds,
            *TissueFeeds(self, post, settings.rate, rest).feeds,
            structures.feed,
        )
        self._server = WebServer(
            self.sources, settings.host, settings.port, os.environ.get(TOKEN, "")
        )
        self.health.state = "serving"
        self.health.values = {"port": str(self._server.port)}
        print(f"open {' or '.join(self._server.addresses)}", flush=True)
        if self._server.token:
            self.get_logger().warning(
                f"the viewer listens at {settings.host}, for other computers, too: whoever has "
                f"the address with its token can see and move everything, and nothing is encrypted"
            )

    @property
    def _imaging(self) -> Mapping[str, Parameter]:
        return self._remote.get_node("slice_interpolator").parameters

    def _read_arrangement(self) -> tuple[bool, bool]:
        """Return the parameters ``flip`` and ``beside``; False while they are unknown."""
        flip, beside = map(self._imaging.get, ("flip", "beside"))
        return flip is not None and bool(flip.raw), beside is not None and bool(beside.raw)

    def _describe(self, stamp: int) -> dict[str, Any]:
        """Return the scene and the probe's press and force at an image's stamp (ns), in m and N.

        Settings are in the unit that a person reads. ``command`` is the last command that the image
        contains: its page, and the page's number of it, by which the page measures the delay.
        """
        probe = self._probe.find_pose_and_wrench(str(stamp))
        parameters = self._imaging
        known = {
            **self._hand.describe_pose(stamp, probe.get("position")),
            "force": float(np.linalg.norm(probe["force"])) if "force" in probe else None,
            "scene": self._session.state.scene or None,
            "settings": {
                format_name(name): f"{parameter.value:g} {parameter.unit}"
                for name in _IMAGED_WITH
                if (parameter := parameters.get(name)) is not None and parameter.value is not None
            },
        }
        return {name: value for name, value in known.items() if value is not None}

    def destroy_node(self) -> None:
        """Stop the web server, then destroy the node."""
        self._server.close()
        super().destroy_node()


main = node_main(Viewer, __name__)
