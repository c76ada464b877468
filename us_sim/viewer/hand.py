"""The hand of the pages: moves the probe as they ask, unless somebody else moves it.

>>> from us_sim.tracking.virtual_hand import RestSurface, Stance
>>> asked = HandCommand.read({"source": "a", "sequence": 7, "to": {"press": 0.004}})
>>> asked = asked.stance(Stance(rotation=0.1), RestSurface.plane(0.1))
>>> asked.press, asked.rotation
(0.004, 0.1)
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import PurePath
from typing import Any, TypeGuard

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from numpy.typing import ArrayLike
from shape_msgs.msg import Mesh

from us_sim.errors import MessageError, UsSimError
from us_sim.geometry.pose import Pose
from us_sim.nodes.guarded_node import GuardedNode, Subscriptions
from us_sim.nodes.messages import pose_message
from us_sim.nodes.qos import LATCHED, STREAM
from us_sim.nodes.scene_node import LEAD_TOPIC
from us_sim.nodes.settings import PLAYERS
from us_sim.recording.decoding import mesh_from, pose_from, pose_from_text
from us_sim.settings.spelling import shown
from us_sim.tracking.measurement import PATIENT, TrackingState
from us_sim.tracking.virtual_hand import DEEPEST, HIGHEST, STEEPEST, Motion, RestSurface, Stance
from us_sim.viewer.feeds import RestMesh
from us_sim.viewer.session import SessionState
from us_sim.viewer.stream import Feed, Packet, Posted, Simulator

HOME_PRESS = 1e-3  # m: where the probe begins it touches, so that there is an image
LIFTED = -0.01  # m

_FARTHEST, _FULL = 10.0, 2.0 * math.pi
_TO = {"point": 3, "x": 1, "y": 1, "press": 1, "rotation": 1, "fan": 1, "rock": 1}
_BY = {"slide": 2, "press": 1, "rotation": 1, "fan": 1, "rock": 1}
_ANGLES = ("rotation", "fan", "rock")
_SINGLE = ("press", *_ANGLES)
_PLACES = ("home", "lift", "upright")
_LONGEST_SOURCE, _LAST = 40, 2**53


@dataclass(frozen=True)
class HandCommand:
    """One wish, as absolute values, changes, or a place that has a name."""

    source: str  # of which page
    sequence: int  # the page's number of the wish
    to: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # m and rad, by _TO
    by: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # m and rad, by _BY
    go: str | None = None  # home: begin anew; lift: off the skin; upright: no angles

    @classmethod
    def read(cls, value: Any) -> HandCommand:
        """The wish that a page sent, decoded from JSON.

        Raises:
            MessageError: it is none, with what is wrong.
        """
        if not isinstance(value, dict):
            raise MessageError(f"a command to the hand is an object, not {shown(value)}")
        unknown = value.keys() - {"source", "sequence", "to", "by", "go"}
        if unknown:
            raise MessageError(f"a command to the hand has no {shown(min(unknown))}")
        source, sequence, go = value.get("source"), value.get("sequence"), value.get("go")
        if not is_source(source):
            raise MessageError(
                f"the hand's source is a text of 1 to {_LONGEST_SOURCE} characters, not "
                f"{shown(source)}"
            )
        if type(sequence) is not int or not 0 <= sequence <= _LAST:
            raise MessageError(f"the hand's sequence is a count, not {shown(sequence)}")
        if go is not None and go not in _PLACES:
            raise MessageError(f"the hand goes to {', '.join(_PLACES)}, not to {shown(go)}")
        to, by = _numbers(value, "to", _TO), _numbers(value, "by", _BY)
        return cls(source, sequence, to, by, go)

    def stance(self, goal: Stance, surface: RestSurface) -> Stance:
        """The stance that is wanted now, within a hand's limits.

        Args:
            goal: what was wanted before.
            surface: that the probe stands on.
        """
        if self.go == "home":
            goal = Stance.home(surface, HOME_PRESS)
        elif self.go == "lift":
            goal = replace(goal, press=LIFTED)
        elif self.go == "upright":
            goal = replace(goal, rotation=0.0, fan=0.0, rock=0.0)
        wanted: dict[str, Any] = {name: n[0] for name, n in self.to.items() if name in _SINGLE}
        goal = replace(goal, **wanted)
        if "point" in self.to:
            goal = replace(goal, point=surface.closest(np.array(self.to["point"])).point)
        if "x" in self.to or "y" in self.to:
            x, y = (self.to.get(name, (goal.point[axis],))[0] for axis, name in enumerate("xy"))
            goal = replace(goal, point=surface.above(x, y).point)
        if "slide" in self.by:
            goal = goal.slid(surface, *self.by["slide"])
        changed = {n: getattr(goal, n) + self.by[n][0] for n in _SINGLE if n in self.by}
        return replace(goal, **changed).within_reach()


def is_source(value: Any) -> TypeGuard[str]:
    """Whether it can be the name that a page has given itself."""
    return isinstance(value, str) and 0 < len(value) <= _LONGEST_SOURCE


def _numbers(
    value: dict[str, Any], key: str, sizes: dict[str, int]
) -> dict[str, tuple[float, ...]]:
    """The numbers of one part of a command, each as many as there must be."""
    given = value.get(key, {})
    if not isinstance(given, dict):
        raise MessageError(f"the hand's {key} is an object, not {shown(given)}")
    numbers = {}
    for name, listed in given.items():
        if name not in sizes:
            raise MessageError(f"the hand cannot move {shown(name)}: {', '.join(sizes)}")
        values = listed if isinstance(listed, list) else [listed]
        proper = all(type(n) in (int, float) and abs(n) <= sys.float_info.max for n in values)
        if not proper or len(values) != sizes[name]:
            raise MessageError(
                f"the hand's {name} is {sizes[name]} finite number{'s' * (sizes[name] > 1)}, not "
                f"{shown(listed)}"
            )
        limit = _FULL if name in _ANGLES else _FARTHEST
        if max(map(abs, values)) > limit:
            far, end = max(values, key=abs), limit
            if name in _ANGLES:
                far, end = math.degrees(far), math.degrees(end)
            unit = "°" if name in _ANGLES else " m"
            raise MessageError(
                f"the hand's {name} is -{end:.4g} to {end:.4g}{unit}, not {far:.4g}{unit}"
            )
        numbers[name] = tuple(map(float, values))
    return numbers


def hand_state(
    surface: RestSurface | None, stance: Stance | None, goal: Stance | None
) -> dict[str, Any]:
    """Where the probe is and goes, and where it may be, as far as that is known.

    Args:
        surface: on which it stands.
        stance: how it is held.
        goal: how it will be.

    Returns:
        m and rad, frame ``patient``.
    """
    state: dict[str, Any] = {}
    if stance is not None and goal is not None:
        state |= {"stance": _stance_numbers(stance), "goal": _stance_numbers(goal)}
    if surface is not None:
        lower, upper = surface.lower.tolist(), surface.upper.tolist()
        state["range"] = {
            "x": [lower[0], upper[0]],
            "y": [lower[1], upper[1]],
            "press": [-HIGHEST, DEEPEST],
            "tilt": [-STEEPEST, STEEPEST],
        }
    return state


def _stance_numbers(stance: Stance) -> dict[str, float]:
    place = dict(zip("xyz", stance.point.tolist(), strict=True))
    return place | {name: getattr(stance, name) for name in _SINGLE}


_KEPT = 512  # poses, until their images are made
_MOVES_S = 2.0  # after its last wish a page holds the probe, and moves it no more


class AskedPoses:
    """The commands of pages, and the poses that obey them.

    It is written in one thread, and may be read in others.
    """

    def __init__(self) -> None:
        self.at = 0.0
        """When the last wish came, s of the monotonic clock."""
        self.holder = ""
        """The page that acted last; nothing if none has, or once it has gone."""
        self._connection = 0
        self._last: tuple[str, int] | None = None
        self._by_stamp: dict[int, tuple[float, tuple[str, int] | None]] = {}

    @property
    def is_moving(self) -> bool:
        """Whether the page that holds the probe has moved it a moment ago."""
        return bool(self.holder) and time.monotonic() - self.at < _MOVES_S

    def ask(self, source: str, sequence: int, connection: int = 0) -> None:
        """A page (``source``), on a connection, has a wish, by the page's own number."""
        self._last = (source, sequence)
        self.at = time.monotonic()
        self.hold(source, connection)

    def hold(self, source: str, connection: int = 0) -> None:
        """A page holds the probe from here on, until another acts or its connection ends."""
        self.holder, self._connection = source, connection

    def left(self, connection: int) -> None:
        """A connection has ended."""
        if connection == self._connection:
            self.holder = ""

    def published(self, stamp: int, press: float) -> None:
        """The pose of a stamp (ns), pressed so deep (m), contains all wishes until now."""
        self._by_stamp[stamp] = press, self._last
        if len(self._by_stamp) > _KEPT:
            del self._by_stamp[next(iter(self._by_stamp))]

    def by(self, stamp: int) -> tuple[str, int] | None:
        """The page, and the number of its last wish, that the pose of a stamp (ns) contains."""
        return self._by_stamp.get(stamp, (0.0, None))[1]

    def press(self, stamp: int) -> float | None:
        """How deep (m) the pose of a stamp (ns) is pressed; None for poses of others."""
        return self._by_stamp.get(stamp, (None, None))[0]


@dataclass(frozen=True)
class Lead:
    """Who leads, and whether a page's hand may."""

    who: str  # a node, "tracker" for the scene's own, "hand", or "nobody"
    obstacle: str = ""  # why the hand may not move the probe, for a person; "" if it may
    can_take: bool = False  # whether a page can end what moves it


def probe_lead(node: GuardedNode, session: SessionState, *, is_publishing: bool) -> Lead:
    """Who moves the probe, by who publishes and hears ``tracker/pose``.

    Args:
        node: whose hand would move it.
        session: what is replayed.
        is_publishing: whether that hand publishes already.
    """
    name = node.resolve_topic_name(LEAD_TOPIC)
    others = [info.node_name for info in node.get_publishers_info_by_topic(name)]
    if is_publishing and node.get_name() in others:
        others.remove(node.get_name())
    if others and others[0] in PLAYERS and session.replay:
        what = "moves the probe"
        if session.replay_state == "finished":
            what = "has ended"
            what += " and holds the probe" if others[0] == PLAYERS[0] else ""
        obstacle = f"the replay of {PurePath(session.replay).name} {what}"
        return Lead(others[0], obstacle, can_take=True)
    if others:
        return Lead(others[0], f"{others[0]} moves the probe: end it to take the probe yourself")
    hearers = [info.node_name for info in node.get_subscriptions_info_by_topic(name)]
    if "probe_tracker" in hearers:
        return Lead("hand")
    if _is_offered(node, "probe/pose"):
        return Lead(
            "tracker",
            "the probe follows the scene's own tracker: start without --tracker, or with --param "
            "probe_tracker.source=pose, to take it yourself",
        )
    return Lead("nobody", "no simulator with a probe runs yet")


def _is_offered(node: GuardedNode, topic: str) -> bool:
    """Whether anybody publishes a topic."""
    return node.count_publishers(node.resolve_topic_name(topic)) > 0


class ViewerSurface:
    """The skin at rest; where the scene has none the tissue's upper side, else the plane z = 0.

    Args:
        node: that hears ``skin/mesh``.
        rest: the tissue's mesh.
        changed: called when there is another surface.
    """

    def __init__(self, node: GuardedNode, rest: RestMesh, changed: Callable[[], None]) -> None:
        self._node, self._rest, self._changed = node, rest, changed
        self._skin: RestSurface | None = None
        self._tissue: RestSurface | None = None
        self._plane = RestSurface.plane(0.1)  # m around the origin
        self._heard = node.create_subscription(Mesh, "skin/mesh", self._take_skin, LATCHED)
        rest.watch(self._make_tissue)
        node.guarded(node.resolve_topic_name("tissue/rest"), self._make_tissue)()

    @property
    def best(self) -> RestSurface | None:
        """The surface; None while one is still awaited."""
        is_skin_offered = _is_offered(self._node, "skin/mesh")
        if self._skin is not None and (self._tissue is None or is_skin_offered):
            return self._skin
        if self._tissue is not None:
            return self._tissue
        is_awaited = is_skin_offered or _is_offered(self._node, "tissue/rest")
        return None if is_awaited else self._plane

    def close(self) -> None:
        """Hear no more."""
        self._node.destroy_subscription(self._heard)
        self._rest.watch(self._make_tissue, is_wanted=False)

    def _take_skin(self, message: Mesh) -> None:
        self._skin = RestSurface(*mesh_from(message))
        self._changed()

    def _make_tissue(self) -> None:
        if self._rest.mesh is not None:
            self._tissue = RestSurface.upper_side(self._rest.mesh.nodes, self._rest.mesh.boundary)
            self._changed()


MOVING = 60.0 if (os.cpu_count() or 1) > 2 else 30.0
"""Poses a second: on two cores the simulator and the browser share them, and a page shows no more
images than that."""
RESTING = 5.0  # poses a second; images are called stale after half a second
STREAMING, LATEST = 3.0, 1.45
"""From pose to pose: how long after a command the next is expected, and then waited for. A timer's
pose just before it would hold up the command's own."""
LONGEST_STEP = 0.05
"""s of movement at most between two poses: were the node held up, the probe would leap."""
UNANSWERED = 3.0
"""s without a pose of the tracked probe, after which it is said that nobody answers."""
ASTRAY, SETTLED = 3e-3, 1.0
"""m, and s of rest, from which on the tracked probe is not where it was put."""


class ViewerHand:
    """A tracker source that pages move: ``tracker/pose`` in frame ``patient``.

    It publishes only while a page watches and nobody else does: a driver or a player leads as long
    as it has a publisher, and the hand goes on from where that has left the probe. Poses come as
    soon as a page asks, `MOVING` times a second while the probe moves or a page watches what goes
    on by itself, such as blood, and `RESTING` else.

    Args:
        node: that publishes.
        post: has work done in the node's thread.
        simulator: given the stream ``hand`` and the command of the same name.
        rest: the tissue's mesh, on which the probe stands where there is no skin.
    """

    def __init__(
        self, node: GuardedNode, post: Posted, simulator: Simulator, rest: RestMesh
    ) -> None:
        self._node, self._post, self._rest = node, post, rest
        # To a person's eye sliders follow at 10 Hz, and more would take time from the image.
        self.feed = Feed("hand", lambda _: post(self._watch), 10.0)
        self._simulator = simulator
        simulator.add(self.feed)
        simulator.commands["hand"] = self._command
        simulator.commands["take"] = self._ask_for_probe
        simulator.leaving.append(lambda page: post(lambda: self.asked.left(page)))
        self._session = simulator.session
        self._lead = Lead("nobody", "the viewer finds out who moves the probe")
        self._surface: ViewerSurface | None = None
        self._standing: RestSurface | None = None  # the surface that the motion is on
        self._motion: Motion | None = None
        self._publisher: Any = None
        self._subscriptions = Subscriptions(
            node,
            (PoseStamped, "probe/pose", self._follow, STREAM, False),
            (DiagnosticStatus, "probe/status", self._find, LATCHED, False),
        )
        self._is_found = False  # whether it is known where the probe is, or that it is nowhere yet
        self._elsewhere: Pose | None = None  # where somebody else has the probe
        self._last_stamp = 0  # ns, of the last pose
        self.asked = AskedPoses()
        self._sent_at = self._rests_since = self._taken_at = 0.0  # s, of the monotonic clock
        self._warning = ""
        self._followed_at = 0.0  # s, monotonic: when it was last said where the probe is
        self._moving_timer = node.create_timer(0.5 / MOVING, self._tick)
        self._resting_timer = node.create_timer(1.0 / RESTING, self._update)
        self._moving_timer.cancel()
        self._resting_timer.cancel()

    def press(self, stamp: int, position: ArrayLike | None) -> float | None:
        """How deep (m) the probe is pressed, see `Stance`; None while that is not known.

        Args:
            stamp: ns, of its pose.
            position: (3,) m, where it is, for poses of others.
        """
        known, surface = self.asked.press(stamp), self._standing
        if known is not None or surface is None or position is None:
            return known
        return surface.under(np.asarray(position, dtype=np.float64))[1]

    def _command(self, value: Any, page: int) -> str | None:
        """Take a page's command, in its thread; why it is not done, or None."""
        try:
            asked = HandCommand.read(value)
        except UsSimError as error:
            return str(error)
        if self._lead.obstacle:
            return self._lead.obstacle
        self._post(lambda: self._obey(asked, page))
        return None

    def _watch(self) -> None:
        """Begin with the first page, and leave everything when the last has gone."""
        if self.feed.is_watched and self._surface is None:
            self._surface = ViewerSurface(self._node, self._rest, self._stand)
            self._session.watch()
            self._is_found = False
            self._subscriptions.keep(True)
            self._resting_timer.reset()
            self._update()
        elif not self.feed.is_watched and self._surface is not None:
            self._let_go()
            self._surface.close()
            self._surface = None
            self._subscriptions.keep(False)
            self._session.unwatch()
            self._resting_timer.cancel()

    def _stand(self) -> None:
        """On another surface: where the probe is, if that is near, else at home."""
        surface = self._surface.best if self._surface is not None else None
        if surface is None or surface is self._standing:
            return
        self._standing = surface
        if self._motion is None:
            return
        stance = self._motion.stance
        foot = surface.closest(stance.point)
        if float(np.linalg.norm(foot.point - stance.point)) < 0.02:  # of the same patient
            self._motion.rest_at(replace(stance, point=foot.point))
        else:
            self._motion.rest_at(Stance.home(surface, HOME_PRESS))

    def _update(self) -> None:
        """Find out who leads and where to stand, and publish the pose at rest."""
        self._stand()
        self._lead = self._lead_now()
        if self._lead.obstacle:
            self._let_go()
            self._tell()
            return
        if self._publisher is None:
            self._take()
        if self._moving_timer.is_canceled():
            self._publish()
            if self._simulator.is_changing_by_itself:
                self._moving_timer.reset()

    def _lead_now(self) -> Lead:
        """Who moves the probe; the hand, if there is also somewhere to begin."""
        lead = probe_lead(
            self._node, self._session.state, is_publishing=self._publisher is not None
        )
        if lead.obstacle:
            return lead
        if self._standing is None:
            return Lead("nobody", "the patient's surface is awaited")
        if not self._is_found and _is_offered(self._node, "probe/status"):
            return Lead("nobody", "the viewer finds out where the probe is")
        return lead

    def _take(self) -> None:
        """Lead from here on: from where the probe is, or else where it was held, or at home."""
        assert self._standing is not None
        if self._elsewhere is not None:
            self._motion = Motion(Stance.of(self._elsewhere, self._standing))
            self._elsewhere = None
        elif self._motion is None:
            self._motion = Motion(Stance.home(self._standing, HOME_PRESS))
        self._publisher = self._node.stream(PoseStamped, LEAD_TOPIC)
        self._rests_since = self._taken_at = time.monotonic()

    def _let_go(self) -> None:
        self._moving_timer.cancel()
        self._warning = ""
        if self._publisher is not None:
            self._node.destroy_publisher(self._publisher)
            self._publisher = None
        if self._motion is not None:
            self._motion.rest_at(self._motion.stance)

    def _ask_for_probe(self, value: Any, page: int) -> str | None:
        """Hold the probe that nobody holds, or that a replay moves, which ends; in its thread."""
        if self._lead.can_take:
            self._session.ask(replay="")
        elif self._lead.obstacle or self.asked.holder not in ("", value):
            return self._lead.obstacle or None
        if is_source(value):
            self._post(lambda: self.asked.hold(value, page))
        return None

    def _find(self, status: DiagnosticStatus) -> None:
        """Where the probe was when poses ended; there it is unless this hand has had it."""
        said = {each.key: each.value for each in status.values}
        if "pose" in said:
            pose, stamp = pose_from_text(said["pose"]), said.get("stamp", "")
            if self._publisher is None and stamp != str(self._last_stamp):
                self._elsewhere = pose
        elif status.message != TrackingState.WAITING.value:  # poses come
            self._is_found |= self._motion is not None
            return
        self._is_found = True
        self._update()

    def _follow(self, message: PoseStamped) -> None:
        """Where the probe is: there somebody else has it, or there it should not be."""
        pose = pose_from(message, PATIENT)
        self._followed_at = time.monotonic()
        if self._publisher is None or self._motion is None or self._standing is None:
            self._elsewhere, self._is_found = pose, True
        elif (
            self._motion.is_at_rest
            and time.monotonic() - self._rests_since > SETTLED
            and not self._warning
        ):
            wanted = self._motion.stance.pose(self._standing).position
            distance = float(np.linalg.norm(pose.position - wanted))
            if distance > ASTRAY:
                self._warning = (
                    f"the probe is {1e3 * distance:.0f} mm from where it is held: the scene "
                    f"registers or calibrates poses in frame patient; give its tracker another "
                    f"frame"
                )

    def _obey(self, asked: HandCommand, page: int) -> None:
        """Move to where a page wants the probe, from now on."""
        if self._publisher is None or self._motion is None or self._standing is None:
            return  # somebody else has taken it meanwhile
        self._motion.aim(asked.stance(self._motion.goal, self._standing))
        self.asked.ask(asked.source, asked.sequence, page)
        rested = self._moving_timer.is_canceled()
        if rested:
            self._moving_timer.reset()
        if rested or self.asked.at - self._sent_at > 0.5 / MOVING:
            self._advance(1.0 / MOVING if rested else LONGEST_STEP)

    def _tick(self) -> None:
        now = time.monotonic()
        is_streaming = now - self.asked.at < STREAMING / MOVING
        if now - self._sent_at > (LATEST if is_streaming else 0.9) / MOVING:
            self._advance(LONGEST_STEP)

    def _advance(self, longest: float) -> None:
        """Publish where the movement is by now; at most so many s after the last pose."""
        if self._publisher is None or self._motion is None:
            self._moving_timer.cancel()
            return
        if not self._motion.is_at_rest:
            self._motion.advance(min(time.monotonic() - self._sent_at, longest))
            self._rests_since = time.monotonic()
        self._publish()
        if self._motion.is_at_rest and not self._simulator.is_changing_by_itself:
            self._moving_timer.cancel()
            self._resting_timer.reset()
            self._tell()

    def _publish(self) -> None:
        assert self._motion is not None
        assert self._standing is not None
        stamp = self._node.get_clock().now()
        self._last_stamp = stamp.nanoseconds
        stance = self._motion.stance
        pose = stance.pose(self._standing)
        # Said first: its image may be there at once.
        self.asked.published(stamp.nanoseconds, stance.press)
        self._publisher.publish(pose_message(pose, stamp.to_msg(), PATIENT))
        self._sent_at = time.monotonic()
        self._node.health.published(LEAD_TOPIC)
        self._tell()

    def _unanswered(self) -> str:
        """Whether nobody follows the poses any more that are published; "" if somebody does."""
        silent = time.monotonic() - max(self._followed_at, self._taken_at)
        if self._publisher is None or silent < UNANSWERED:
            return ""
        return f"The simulator does not answer: the probe has not followed for {silent:.0f} s"

    def _tell(self) -> None:
        """Tell the pages how the probe is held, and by whom."""
        motion, surface = self._motion, self._standing
        stance = motion.stance if motion is not None else None
        goal = motion.goal if motion is not None else None
        if self._publisher is None and self._elsewhere is not None and surface is not None:
            stance = goal = Stance.of(self._elsewhere, surface)
        header = {
            "leader": self._lead.who,
            "holder": self.asked.holder,
            "is_moving": self.asked.is_moving,
            "every": 1.0 / RESTING,  # s, at the latest
            "is_resting": self._publisher is not None and self._moving_timer.is_canceled(),
            "obstacle": self._lead.obstacle,
            "can_take": self._lead.can_take,
            "warning": self._unanswered() or self._warning,
            **hand_state(surface, stance, goal),
        }
        self.feed.offer(lambda sequence: Packet("hand", sequence, header, b""))
