"""The topics of the graph, without any ROS: contents, publishers and subscribers of each.

>>> from us_sim.nodes.topics import TOPICS
>>> [topic.name for topic in TOPICS if topic.latched and "slice_interpolator" in topic.publishers]
['ultrasound/image_to_probe']
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from us_sim.settings.text_files import load_yaml


@dataclass(frozen=True)
class Topic:
    """One topic, by its name in the simulator's namespace."""

    name: str
    type_name: str  # package and message: geometry_msgs/PoseStamped
    description: str  # for a person
    publishers: Sequence[str] = ()  # nodes of this package; none if a driver publishes it
    subscribers: Sequence[str] = ()
    latched: bool = False  # kept for later subscribers
    on_demand: bool = False  # not recorded, and so not computed, unless the recorder names it

    @property
    def is_from_drivers(self) -> bool:
        """True if it comes from outside this package, or from a node in place of a driver."""
        stand_ins = {"path_player", "camera_driver", "space_mouse_driver", "probe_robot", "viewer"}
        return set(self.publishers) <= stand_ins


FROZEN = "frozen"  # the text of a page that freezes its image

_KNOWN = load_yaml(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
TOPICS = tuple(Topic(name, **about) for name, about in _KNOWN.items())
"""Those of ``topics.yaml``, which lies beside this file."""
