"""Tasks of `us_sim.environment`: reward and success, from the truth that a simulator knows.

The rewards of an episode's steps sum to between -1 and 0; what is done of the task adds up to 1,
and is taken back where it is undone.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from us_sim.environment.simulation import ScanSimulation, ScanState
from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import rotation_exp
from us_sim.slicing.settings import WALLS_TOUCH

_OPEN = 0.5
"""Part of its area at rest from which a vein counts as open."""
_HARDLY_CUT = 0.1
"""Part of its largest cross-section at rest in the episode below which a vessel is not in view."""
_TOUCHING = 0.9
"""Part of the face that touches."""


class EpisodeTask(ABC):
    """A task of one episode."""

    has_goal: ClassVar[bool] = False  # observations have the pose of `compute_goal`

    def __init__(self, simulation: ScanSimulation) -> None:
        self._simulation = simulation
        self._held = 0  # steps in a row

    def begin_episode(self, state: ScanState) -> None:  # noqa: B027 - most tasks begin alike
        """Begin with the probe at the start of an episode."""

    @abstractmethod
    def judge_step(self, state: ScanState) -> tuple[float, float]:
        """Return a step's reward, -1 to 0, and the part of the task that is done, 0 to 1."""

    def compute_goal(self, step: int) -> Pose:  # noqa: ARG002
        """Return the pose to reach, if the task has a goal."""
        return Pose()

    def collect_facts(self) -> dict[str, float]:
        """Return the task's truths of the last step, by name; NaN if unknown."""
        return {}

    def _has_held(self, is_right: bool, steps: int) -> bool:
        """Count right steps; return True once there are ``steps`` in a row."""
        self._held = self._held + 1 if is_right else 0
        return self._held >= steps


class _VesselTask(EpisodeTask):
    """A task of the target vessel; its area is compared with that in the same plane at rest."""

    def __init__(self, simulation: ScanSimulation) -> None:
        super().__init__(simulation)
        self._label = simulation.find_label(simulation.scene.episode.target)
        self._largest = 0.0  # m²
        self.fraction = 1.0  # of the area at rest
        self.offset = np.nan  # m, of the vessel from the image's middle; NaN unseen

    def begin_episode(self, state: ScanState) -> None:
        """Measure the vessel."""
        self._measure_vessel(state)

    def _measure_vessel(self, state: ScanState) -> None:
        area = self._simulation.pixel_area
        rest = self._simulation.compute_labels_at_rest(state.pose) == self._label
        now = state.labels == self._label
        at_rest = float(rest.sum()) * area
        self._largest = max(self._largest, at_rest)
        is_cut_off = bool(rest[:, [0, -1]].any())
        if at_rest <= _HARDLY_CUT * self._largest or is_cut_off:
            self.fraction, self.offset = 1.0, np.nan
            return
        self.fraction = float(now.sum()) * area / at_rest
        columns = np.nonzero(now if now.any() else rest)[1]
        probe = self._simulation.scanner.probe
        middle = (probe.columns - 1) / 2
        self.offset = float((columns.mean() - middle) * probe.pixel_spacing[0])

    def collect_facts(self) -> dict[str, float]:
        """Return the area over that at rest, and the offset (m), NaN if it is not in view."""
        return {"target_area_fraction": self.fraction, "target_offset": self.offset}


class FindVein(_VesselTask):
    """Bring the vein to the image's middle, in contact and not pressed flat."""

    def judge_step(self, state: ScanState) -> tuple[float, float]:
        """Reward half by nearness to the middle, half by contact that leaves the vein open."""
        self._measure_vessel(state)
        half = self._simulation.scanner.probe.width / 2
        distance = float(np.fmin(abs(self.offset), half))
        is_open = self.fraction >= _OPEN
        is_right = distance <= 2e-3 and is_open and state.contact >= _TOUCHING
        reward = -0.5 * distance / half - 0.5 * (1.0 - state.contact * is_open)
        return reward, float(self._has_held(is_right, 10))


class CompressVein(_VesselTask):
    """Compress the vein to closure, and let go."""

    def __init__(self, simulation: ScanSimulation) -> None:
        super().__init__(simulation)
        self.is_closed = False  # at some time in the episode

    def judge_step(self, state: ScanState) -> tuple[float, float]:
        """Return no reward, and the part that is done, which grows as the episode proceeds.

        Up to 0.1 for contact and 0.2 for less of the vein, 0.5 once it was closed, up to 0.3 more
        for less force, and all of it when the vein is let go.
        """
        self._measure_vessel(state)
        if not self.is_closed:
            self.is_closed = self._has_held(self.fraction <= WALLS_TOUCH, 5)
        if not self.is_closed:
            shut = np.clip((1.0 - self.fraction) / (1.0 - WALLS_TOUCH), 0.0, 1.0)
            return 0.0, 0.1 * state.contact + 0.2 * float(shut)
        if state.force < 1.0 and self.fraction >= _OPEN:
            return 0.0, 1.0
        pressed = max(state.force, 0.0) / self._simulation.scene.episode.force
        return 0.0, 0.5 + 0.3 * (1.0 - min(pressed, 1.0))

    def collect_facts(self) -> dict[str, float]:
        """Add ``closed``, 1 once the vein was closed."""
        return super().collect_facts() | {"closed": float(self.is_closed)}


class HoldContact(EpisodeTask):
    """Hold a force on the skin."""

    def judge_step(self, state: ScanState) -> tuple[float, float]:
        """Reward nearness to the force."""
        error = abs(state.force - 4.0) / 4.0
        is_right = error <= 0.2 and state.contact >= _TOUCHING
        return -min(error, 1.0), float(self._has_held(is_right, 60))


class FollowPlane(EpisodeTask):
    """Follow an image plane that slides along the arm and turns."""

    has_goal = True

    def __init__(self, simulation: ScanSimulation) -> None:
        super().__init__(simulation)
        probe = simulation.scanner.probe
        x, z = probe.width / 2, probe.depth
        self._corners = np.array([[-x, 0.0, 0.0], [x, 0.0, 0.0], [-x, 0.0, z], [x, 0.0, z]])
        self._start, self._step, self._error = Pose(), 0, 0.0

    def begin_episode(self, state: ScanState) -> None:
        """Begin under the probe, pressed by 2 mm and upright."""
        self._start = Pose(np.array([*state.pose.position[:2], 2e-3]))

    def compute_goal(self, step: int) -> Pose:
        """Return the pose of the plane at a step."""
        part = min(step / 200, 1.0)
        turn = np.array([0.0, 0.0, np.deg2rad(10.0) * part])
        return self._start @ Pose(np.array([0.0, 10e-3 * part, 0.0]), rotation_exp(turn))

    def judge_step(self, state: ScanState) -> tuple[float, float]:
        """Reward nearness to the plane."""
        self._step += 1
        apart: NDArray[np.float64] = self.compute_goal(self._step).transform_points(self._corners)
        apart = apart - state.pose.transform_points(self._corners)
        self._error = float(np.linalg.norm(apart, axis=1).max())
        return -min(self._error / 0.02, 1.0), float(self._has_held(self._error <= 2e-3, 60))

    def collect_facts(self) -> dict[str, float]:
        """Return the largest distance (m) of a corner of the image from its goal."""
        return {"plane_error": self._error}


TASKS: dict[str, type[EpisodeTask]] = {
    task.__name__: task for task in (FindVein, CompressVein, HoldContact, FollowPlane)
}
