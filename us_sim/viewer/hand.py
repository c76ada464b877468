"""The pages' hand: it moves the probe as pages ask, unless something else moves it."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import PurePath
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from numpy.typing import ArrayLike
from shape_msgs.msg import Mesh

from us_sim.errors import UsSimError
from us_sim.geometry.pose import Pose
from us_sim.nodes.guarded_node import GuardedNode, Subscriptions, keep_newest
from us_sim.nodes.messages import pose_message
from us_sim.nodes.qos import LATCHED, STREAM
from us_sim.nodes.scene_node import LEAD_TOPIC
from us_sim.nodes.settings import PLAYERS
from us_sim.recording.decoding import mesh_from, pose_from, pose_from_text
from us_sim.tracking.measurement import PATIENT, TrackingState
from us_sim.tracking.virtual_hand import (
    DEEPEST,
    HIGHEST,
    STEEPEST,
    Stance,
    StanceMotion,
    StandingSurface,
)
from us_sim.viewer.feeds import RestMeshListener
from us_sim.viewer.hand_command import HOME_PRESS, SINGLE, HandCommand, is_source
from us_sim.viewer.session import SessionState
from us_sim.viewer.stream import CallPoster, Feed, Packet, PageSources

MOVING_HZ = 60.0 if (os.cpu_count() or 1) > 2 else 30.0
"""Poses a second; on two cores, which the browser shares, a page shows no more images than 30."""
RESTING_HZ = 5.0  # poses a second; images are called stale after half a second
STREAMING, LATEST = 3.0, 1.45
"""In intervals of poses: the time after a command in which the next is expected, and the longest
wait for it. A timer's pose just before a command would hold up the command's own."""
LONGEST_STEP = 0.05  # s of movement between two poses; after a delay the probe would leap
UNANSWERED = 3.0  # s without a pose of the tracked probe, after which the page warns
ASTRAY, SETTLED = 3e-3, 1.0
"""m from the commanded place, and s of rest before it is measured, beyond which the page warns."""
SAME_PATIENT = 0.02  # m from an old surface to a new one: nearer, the probe stays in its place
_KEPT = 512  # poses that are kept until their images come
_HELD = "another page holds the probe: Take over moves it to this one"


@dataclass(frozen=True)
class ProbeLead:
    """The source that moves the probe, and whether the hand may do so."""

    who: str  # a node, "tracker" for the scene's own, "hand", or "nobody"
    obstacle: str = ""  # reason for a person why the hand may not move the probe, if any
    can_take: bool = False  # a page can end what moves it


def find_lead(node: GuardedNode, session: SessionState, *, is_publishing: bool) -> ProbeLead:
    """Find out who moves the probe, by the publishers and subscribers of ``tracker/pose``.

    Args:
        node: the node of the hand.
        session: tells what is replayed.
        is_publishing: the hand publishes already.
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
        return ProbeLead(others[0], obstacle, can_take=True)
    if others:
        return ProbeLead(
            others[0], f"{others[0]} moves the probe: end it to take the probe yourself"
        )
    subscribers = [info.node_name for info in node.get_subscriptions_info_by_topic(name)]
    if "probe_tracker" in subscribers:
        return ProbeLead("hand")
    if _is_offered(node, "probe/pose"):
        return ProbeLead(
            "tracker",
            "the probe follows the scene's own tracker: start without --tracker, or with --param "
            "probe_tracker.source=pose, to take it yourself",
        )
    return ProbeLead("nobody", "no simulator with a probe runs yet")


def _is_offered(node: GuardedNode, topic: str) -> bool:
    return node.count_publishers(node.resolve_topic_name(topic)) > 0


class PatientSurface:
    """The surface to stand on: the skin at rest, else the tissue's upper side, else z = 0.

    Args:
        node: the node that subscribes to ``skin/mesh``.
        rest: follows the tissue's mesh.
    """

    def __init__(self, node: GuardedNode, rest: RestMeshListener) -> None:
        self._node, self._rest = node, rest
        self._skin: StandingSurface | None = None
        self._tissue: StandingSurface | None = None
        corners = [[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, 0.1, 0.0]]  # m
        self._plane = StandingSurface(np.array(corners), np.array([[0, 2, 1], [0, 3, 2]]))
        self._meshes = Subscriptions(node, (Mesh, "skin/mesh", self._on_skin, LATCHED, False))

    def follow_meshes(self, is_wanted: bool) -> None:
        """Begin or end following the meshes of skin and tissue."""
        self._skin = self._tissue = None
        self._meshes.set_active(is_wanted)
        self._rest.set_watcher(self._on_tissue, is_wanted)
        if is_wanted:
            self._node.guard_callback(
                self._node.resolve_topic_name("tissue/rest"), self._on_tissue
            )()

    def find_surface(self) -> StandingSurface | None:
        """Return the surface to stand on; None while one is still awaited."""
        is_skin_offered = _is_offered(self._node, "skin/mesh")
        if self._skin is not None and (self._tissue is None or is_skin_offered):
            return self._skin
        if self._tissue is not None:
            return self._tissue
        is_awaited = is_skin_offered or _is_offered(self._node, "tissue/rest")
        return None if is_awaited else self._plane

    def _on_skin(self, message: Mesh) -> None:
        self._skin = StandingSurface(*mesh_from(message))

    def _on_tissue(self) -> None:
        if self._rest.mesh is not None:
            self._tissue = StandingSurface.create_upper_side(
                self._rest.mesh.nodes, self._rest.mesh.boundary
            )


class HandState(Enum):
    """State of the hand; ``docs/architecture.md`` draws the transitions."""

    IDLE = "no page watches"
    WAITING = "something else leads, or the probe's pose or the surface is unknown"
    RESTING = "the hand holds the probe still"
    MOVING = "the hand moves the probe, or images go on while it rests"

    @property
    def holds_probe(self) -> bool:
        """True while the hand publishes the probe's poses."""
        return self in (HandState.RESTING, HandState.MOVING)


class ViewerHand:
    """A tracker source that pages move: ``tracker/pose`` in frame ``patient``.

    It holds the probe while a page watches and nothing else publishes poses: a driver or a player
    leads as long as it has a publisher, and then the hand goes on from the probe's place. One page
    moves the hand: the first that does, until its connection ends or another page takes over. A
    command publishes a pose at once. Besides, poses come at `MOVING_HZ` while the probe moves or a
    page watches something that goes on by itself, such as blood, and else at `RESTING_HZ`.

    Args:
        node: the node that publishes.
        post: runs calls in the node's thread.
        sources: gets the stream ``hand`` and the commands ``hand`` and ``take``.
        rest: follows the tissue's mesh, on which the probe stands where there is no skin.
    """

    def __init__(
        self, node: GuardedNode, post: CallPoster, sources: PageSources, rest: RestMeshListener
    ) -> None:
        self._node, self._post, self._sources = node, post, sources
        # Sliders that follow at 10 Hz look smooth, and more would take time from the image.
        self.feed = Feed("hand", lambda _: post(self._on_watch), 10.0)
        sources.add_feeds(self.feed)
        sources.commands |= {"hand": self._on_command, "take": self._on_take}
        sources.leaving.append(self._on_leave)
        self._state = HandState.IDLE
        self._lead = ProbeLead("nobody", "the viewer finds out who moves the probe")
        self._surface = PatientSurface(node, rest)
        self._standing: StandingSurface | None = None  # the surface of the motion
        self._motion: StanceMotion | None = None
        self._publisher: Any = None
        self._subscriptions = Subscriptions(
            node,
            (PoseStamped, "probe/pose", self._on_pose, STREAM, False),
            (DiagnosticStatus, "probe/status", self._on_status, LATCHED, False),
        )
        self._is_found = False  # the probe's pose is known, or known not to exist yet
        self._elsewhere: Pose | None = None  # the probe's pose while the hand does not hold it
        # The page that holds the probe, "" if none does, and its connection. Only the web server's
        # thread sets them, in which all commands come: of two pages one is the first.
        self._page, self._connection = "", 0
        self._last: tuple[str, int] | None = None  # command: its page, and the page's number of it
        self._published: dict[int, tuple[float, tuple[str, int] | None]] = {}
        """By stamp (ns): the pose's press (m), and the last command that it contains."""
        self._warning = ""
        # s, monotonic: times of the last command, movement, taking of the probe, tracked pose,
        # published pose, and search for the lead
        self._asked_at = self._moved_at = self._held_at = self._followed_at = 0.0
        self._sent_at = self._looked_at = 0.0
        self._timer = node.create_timer(1.0 / RESTING_HZ, self._on_timer)
        self._timer.cancel()

    def describe_pose(self, stamp: int, position: ArrayLike | None) -> dict[str, Any]:
        """Describe the pose of an image; for any thread.

        Args:
            stamp: ns, of the pose.
            position: (3,) m, of the probe, for poses of other sources.

        Returns:
            ``press`` (m), see `Stance`, and ``command``, the last command in the pose: the page,
            and the page's number of the command. Unknown values are None.
        """
        press, command = self._published.get(stamp, (None, None))
        if press is None and self._standing is not None and position is not None:
            press = self._standing.find_foot(np.asarray(position, dtype=np.float64))[1]
        return {"press": press, "command": command}

    def _enter(self, state: HandState) -> None:
        """Change the state, and begin and end everything that depends on it."""
        before, self._state = self._state, state
        is_watched = state is not HandState.IDLE
        if is_watched != (before is not HandState.IDLE):
            session = self._sources.session
            (session.add_page if is_watched else session.remove_page)()
            self._surface.follow_meshes(is_watched)
            self._subscriptions.set_active(is_watched)
            self._is_found = False
        if state.holds_probe and not before.holds_probe:
            self._take_probe()
        elif before.holds_probe and not state.holds_probe:
            assert self._motion is not None
            self._motion = StanceMotion(self._motion.stance)
            self._node.destroy_publisher(self._publisher)
            self._warning = ""
        rate = 2.0 * MOVING_HZ if state is HandState.MOVING else RESTING_HZ
        self._timer.timer_period_ns = round(1e9 / rate)
        (self._timer.reset if is_watched else self._timer.cancel)()

    def _take_probe(self) -> None:
        """Hold the probe at its present pose, else where it was held last, else at home."""
        assert self._standing is not None
        if self._elsewhere is not None:
            self._motion = StanceMotion(Stance.from_pose(self._elsewhere, self._standing))
            self._elsewhere = None
        elif self._motion is None:
            self._motion = StanceMotion(Stance.create_home(self._standing, HOME_PRESS))
        self._publisher = self._node.create_stream_publisher(PoseStamped, LEAD_TOPIC)
        self._moved_at = self._held_at = time.monotonic()

    def _on_watch(self) -> None:
        """Begin with the first page, and end with the last."""
        if self.feed.is_watched and self._state is HandState.IDLE:
            self._enter(HandState.WAITING)
            self._look()
        elif not self.feed.is_watched and self._state is not HandState.IDLE:
            self._enter(HandState.IDLE)

    def _on_timer(self) -> None:
        now = time.monotonic()
        if self._state is HandState.MOVING:
            is_streaming = now - self._asked_at < STREAMING / MOVING_HZ
            if now - self._sent_at > (LATEST if is_streaming else 0.9) / MOVING_HZ:
                self._advance(LONGEST_STEP)
        if self._state is not HandState.MOVING or now - self._looked_at > 1.0 / RESTING_HZ:
            self._look()

    def _look(self) -> None:
        """Update the surface and the lead; repeat the pose at rest."""
        self._looked_at = time.monotonic()
        self._update_surface()
        self._lead = self._find_lead()
        if self._lead.obstacle:
            if self._state.holds_probe:
                self._enter(HandState.WAITING)
            self._tell()
            return
        if self._state is HandState.WAITING:
            self._enter(HandState.RESTING)
        if self._state is HandState.RESTING:
            self._publish()
            if self._sources.is_changing_by_itself:
                self._enter(HandState.MOVING)

    def _find_lead(self) -> ProbeLead:
        """Return who moves the probe; "nobody" while the surface or the probe's pose is unknown."""
        session = self._sources.session.state
        lead = find_lead(self._node, session, is_publishing=self._state.holds_probe)
        if lead.obstacle:
            return lead
        if self._standing is None:
            return ProbeLead("nobody", "the patient's surface is awaited")
        if not self._is_found and _is_offered(self._node, "probe/status"):
            return ProbeLead("nobody", "the viewer finds out where the probe is")
        return lead

    def _update_surface(self) -> None:
        """Take over a new surface: keep the probe's place if the surface is near, else go home."""
        surface = self._surface.find_surface()
        if surface is None or surface is self._standing:
            return
        self._standing = surface
        if self._motion is None:
            return
        stance = self._motion.stance
        foot = surface.find_closest(stance.point)
        if float(np.linalg.norm(foot.point - stance.point)) < SAME_PATIENT:
            self._motion = StanceMotion(replace(stance, point=foot.point))
        else:
            self._motion = StanceMotion(Stance.create_home(surface, HOME_PRESS))

    def _on_status(self, status: DiagnosticStatus) -> None:
        """Read the probe's last pose from the tracker's report, unless it is this hand's own."""
        values = {each.key: each.value for each in status.values}
        if "pose" in values:
            pose = pose_from_text(values["pose"])
            own = str(next(reversed(self._published), None))
            if not self._state.holds_probe and values.get("stamp") != own:
                self._elsewhere = pose
        elif status.message != TrackingState.WAITING.value:  # poses come
            self._is_found |= self._motion is not None
            return
        self._is_found = True
        if self._state is HandState.WAITING:
            self._look()

    def _on_pose(self, message: PoseStamped) -> None:
        """Record the tracked pose; warn if it differs from the hand's."""
        pose = pose_from(message, PATIENT)
        now = self._followed_at = time.monotonic()
        if not self._state.holds_probe:
            self._elsewhere, self._is_found = pose, True
        elif not self._warning and now - self._moved_at > SETTLED:
            assert self._motion is not None
            assert self._standing is not None
            wanted = self._motion.stance.compute_pose(self._standing).position
            distance = float(np.linalg.norm(pose.position - wanted))
            if distance > ASTRAY:
                self._warning = (
                    f"the probe is {1e3 * distance:.0f} mm from where it is held: the scene "
                    f"registers or calibrates poses in frame patient; give its tracker another "
                    f"frame"
                )

    def _on_command(self, value: Any, connection: int) -> str | None:
        """Accept a page's command, in the web server's thread; return the refusal, or None."""
        try:
            command = HandCommand.read(value)
        except UsSimError as error:
            return str(error)
        if self._lead.obstacle:
            return self._lead.obstacle
        if self._page not in ("", command.source):
            return _HELD
        self._page, self._connection = command.source, connection
        self._post(lambda: self._obey(command))
        return None

    def _on_take(self, page: Any, connection: int) -> str | None:
        """Give a page the probe, whichever page held it, and end a replay that moves it."""
        if self._lead.can_take:
            self._sources.session.ask_control(replay="")
        elif self._lead.obstacle:
            return self._lead.obstacle
        if is_source(page):
            self._page, self._connection = page, connection
        return None

    def _on_leave(self, connection: int) -> None:
        if connection == self._connection:
            self._page = ""

    def _obey(self, command: HandCommand) -> None:
        """Start to move the probe as commanded."""
        if not self._state.holds_probe:
            return  # something else has taken the probe meanwhile
        assert self._motion is not None
        assert self._standing is not None
        self._motion.aim_at(command.change_stance(self._motion.goal, self._standing))
        self._last, self._asked_at = (command.source, command.sequence), time.monotonic()
        if self._state is HandState.RESTING:
            self._enter(HandState.MOVING)
            self._advance(1.0 / MOVING_HZ)
        elif self._asked_at - self._sent_at > 0.5 / MOVING_HZ:
            self._advance(LONGEST_STEP)

    def _advance(self, longest: float) -> None:
        """Publish the motion's present pose, at most ``longest`` s after the last one."""
        assert self._motion is not None
        if not self._motion.is_at_rest:
            self._moved_at = time.monotonic()
            self._motion.advance(min(self._moved_at - self._sent_at, longest))
        self._publish()
        if self._motion.is_at_rest and not self._sources.is_changing_by_itself:
            self._enter(HandState.RESTING)
            self._tell()

    def _publish(self) -> None:
        assert self._motion is not None
        assert self._standing is not None
        stamp = self._node.get_clock().now()
        stance = self._motion.stance
        pose = stance.compute_pose(self._standing)
        # Kept before it is published, as its image may come at once.
        keep_newest(self._published, stamp.nanoseconds, (stance.press, self._last), _KEPT)
        self._publisher.publish(pose_message(pose, stamp.to_msg(), PATIENT))
        self._sent_at = time.monotonic()
        self._node.health.count_published(LEAD_TOPIC)
        self._tell()

    def _tell(self) -> None:
        """Tell the pages the stance, who holds the probe, and warnings."""
        motion, surface = self._motion, self._standing
        stance, goal = (motion.stance, motion.goal) if motion is not None else (None, None)
        if not self._state.holds_probe and self._elsewhere is not None and surface is not None:
            stance = goal = Stance.from_pose(self._elsewhere, surface)
        silent = time.monotonic() - max(self._followed_at, self._held_at)
        warning = self._warning
        if self._state.holds_probe and silent > UNANSWERED:
            warning = (
                f"The simulator does not answer: the probe has not followed for {silent:.0f} s"
            )
        header: dict[str, Any] = {
            "leader": self._lead.who,
            "holder": self._page,
            "every": 1.0 / RESTING_HZ,  # s, at the latest
            "is_resting": self._state is HandState.RESTING,
            "obstacle": self._lead.obstacle,
            "can_take": self._lead.can_take,
            "warning": warning,
        }
        if surface is not None:
            header["range"] = _list_limits(surface)
        if stance is not None and goal is not None:
            header |= {"stance": _list_numbers(stance), "goal": _list_numbers(goal)}
        self.feed.offer_packet(lambda sequence: Packet("hand", sequence, header, b""))


def _list_limits(surface: StandingSurface) -> dict[str, list[float]]:
    """Return the lower and upper limits of a stance, m and rad, frame ``patient``."""
    lower, upper = surface.lower.tolist(), surface.upper.tolist()
    place = {"x": [lower[0], upper[0]], "y": [lower[1], upper[1]]}
    return place | {"press": [-HIGHEST, DEEPEST], "tilt": [-STEEPEST, STEEPEST]}


def _list_numbers(stance: Stance) -> dict[str, float]:
    place = dict(zip("xyz", stance.point.tolist(), strict=True))
    return place | {name: getattr(stance, name) for name in SINGLE}
