"""A gymnasium environment: a hand or a robot arm that scans a patient who gives way.

>>> import gymnasium, us_sim.environment
>>> arm = gymnasium.make("us_sim/FindVein-v0", scene="tests/small_scene.yaml")
>>> observation, info = arm.reset(seed=1)
>>> observation["image"].shape, observation["wrench"].shape
((80, 96), (6,))
>>> observation, reward, terminated, truncated, info = arm.step(arm.action_space.sample())
>>> arm.close()
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from us_sim.environment.simulation import Draw, Simulation, State
from us_sim.environment.tasks import TASKS
from us_sim.errors import EpisodeError, SceneError
from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import exp
from us_sim.scene.reading import merged, parse_scene, scene_document
from us_sim.scene.scene import CASE_PREFIX, Scene
from us_sim.settings.spelling import unknown
from us_sim.tracking.robot import approach_speed, kept_within

DEFAULT_SCENE = "upper_arm_learning"

_LARGEST = 1e3
"""Bound of numbers in SI units, which nothing reaches; spaces without bounds suit few learners."""
_NUMBERS = ("wrench", "displacement", "strain")

Observation = dict[str, NDArray[Any]]


def scene_of(
    scene: str | Scene | None = None,
    case: str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Scene:
    """The scene of that name or file, or of a case, with keys of its own changed.

    Args:
        scene: name or file, or one that was read; `DEFAULT_SCENE` where neither scene nor case is
            given.
        case: name or folder.
        settings: keys of a scene, as its YAML has them.

    Raises:
        EpisodeError: both a scene and a case are given.
        SceneError: the scene cannot be used; one sentence with file and key.
    """
    if scene is not None and case is not None:
        raise EpisodeError(f"scene {scene} and case {case} are both given: name one of them")
    if isinstance(scene, Scene):
        return scene
    name = f"{CASE_PREFIX}{case}" if case is not None else scene or DEFAULT_SCENE
    document, folders, origin = scene_document(name)
    if settings:
        document = merged(document, dict(settings))
    return parse_scene(document, origin=origin, folders=folders)


class ScanEnvironment(gymnasium.Env[Observation, NDArray[np.float32]]):
    """One task in one scene; docs/learning.md says what its actions and observations mean.

    Args:
        task: a name in `TASKS`.
        scene, case, settings: as `scene_of`.
        render_mode: ``rgb_array``, the image; or None.

    Raises:
        EpisodeError: there is no such task or render mode.
        SceneError: the scene cannot be used, or not for this task, or an observation is asked for
            that it cannot give.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as gymnasium's own
        "render_modes": ["rgb_array"],
        "render_fps": 30,
        "autoreset_mode": AutoresetMode.DISABLED,
    }

    def __init__(
        self,
        task: str = "FindVein",
        scene: str | Scene | None = None,
        case: str | None = None,
        settings: Mapping[str, Any] | None = None,
        render_mode: str | None = None,
    ) -> None:
        if task not in TASKS:
            raise EpisodeError(f"task {unknown(task, TASKS)}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise EpisodeError(f"render_mode {unknown(str(render_mode), ['rgb_array'])}")
        self.render_mode = render_mode
        self.scene = scene_of(scene, case, settings)
        self._task_class = TASKS[task]
        self._settings = episode = self.scene.episode
        _require_observable(self.scene)
        self.metadata = {**self.metadata, "render_fps": round(1 / episode.period)}
        self.simulation = Simulation(self.scene)
        self.task = self._task_class(self.simulation)  # refused now rather than at a reset
        self.draw = Draw()
        self._state: State | None = None
        self._step = 0
        self.action_space = spaces.Box(-1.0, 1.0, (6,), np.float32)
        rows, columns = self.simulation.scanner.probe.rows, self.simulation.scanner.probe.columns
        entries: dict[str, spaces.Space[Any]] = {
            "image": spaces.Box(0, 255, (rows, columns), np.uint8),
            "labels": spaces.Box(0, 255, (rows, columns), np.uint8),
            "displacement": _numbers(rows, columns, 2),
            "strain": _numbers(rows, columns),
            "wrench": _numbers(6),
            "pose": _numbers(7),
            "contact": spaces.Box(0.0, 1.0, (1,), np.float32),
            "goal": _numbers(7),
        }
        names = (*episode.observe, *(("goal",) if self.task.has_goal else ()))
        self._spaces: dict[str, Any] = {name: entries[name] for name in names}
        self.observation_space: Any = spaces.Dict(self._spaces)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode with new draws.

        Args:
            seed: decides every byte of the episodes from here on.
            options: ranges, or single values, in place of those of ``episode.draws``.

        Raises:
            SceneError: an option is unknown or out of range.
        """
        super().reset(seed=seed)
        draws = self._settings.draws
        given: dict[str, Any] = {}
        for name, value in (options or {}).items():
            if name not in vars(draws):
                raise SceneError(f"options: {unknown(name, vars(draws))}")
            given[name] = value if isinstance(value, list | tuple) else (value, value)
        self.draw = Draw.of(dataclasses.replace(draws, **given), self.scene, self.np_random)
        self.simulation.reset(self.draw)
        self.task = self._task_class(self.simulation)
        self.task.begin(self.draw.start)
        self._step = 0
        self._late: deque[Observation] = deque(maxlen=self.draw.delay + 1)
        self._state = self.simulation.step(kept_within(self.draw.start, Pose(), self._settings))
        return self._observe(), {"draw": self.draw.document()}

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move the probe for one period.

        Args:
            action: (6,) -1 to 1: linear, then angular velocity in the probe's frame, over ``speed``
                and ``angular_speed`` of the settings. With ``control: force`` the third asks for
                a force, from none at -1 to ``force`` at 1.

        Raises:
            EpisodeError: the action is no six numbers from -1 to 1, or no episode has begun.
        """
        if self._state is None:
            raise EpisodeError("no episode has begun: call reset first")
        velocity = self._velocity(_checked(action))
        moved = self._state.pose @ exp(velocity * self._settings.period)
        pose = kept_within(moved, self._state.pose, self._settings)
        self._state = state = self.simulation.step(pose)
        self._step += 1
        reward, is_done = self.task.judge(state)
        truncated = not is_done and self._step >= self._settings.steps
        info = {
            "is_success": is_done,
            "force": state.force,
            "is_balanced": state.is_balanced,
            **self.task.facts(),
        }
        reward = reward / self._settings.steps + float(is_done)
        return self._observe(), reward, is_done, truncated, info

    def render(self) -> Any:
        """(rows, columns, 3) the image as red, green and blue; None without a render mode.

        Raises:
            EpisodeError: no episode has begun.
        """
        if self.render_mode is None:
            return None
        if self._state is None:
            raise EpisodeError("no episode has begun, so there is no image: call reset first")
        return np.repeat(self._state.image[..., None], 3, axis=2)

    @property
    def state(self) -> State:
        """The truth of the last step.

        Raises:
            EpisodeError: no episode has begun.
        """
        if self._state is None:
            raise EpisodeError("no episode has begun: call reset first")
        return self._state

    def _velocity(self, action: NDArray[np.float64]) -> NDArray[np.float64]:
        """(6,) m/s, rad/s in the probe's frame."""
        given = self._settings
        velocity = action * np.repeat([given.speed, given.angular_speed], 3)
        if given.control == "force":
            wanted = 0.5 * (action[2] + 1.0) * given.force
            damping = given.force_error / given.speed
            velocity[2] = approach_speed(wanted, self.state.force, damping, given.speed)
        return velocity

    def _observe(self) -> Observation:
        state, draw, made = self.state, self.draw, {}
        # Taken always, so that what is observed decides no byte of what comes.
        noise = self.np_random.standard_normal(6)
        noise *= np.repeat([draw.position_noise, draw.orientation_noise], 3)
        for name, space in self._spaces.items():
            if name == "pose":
                made[name] = _seven(state.pose @ exp(noise))
            elif name == "goal":
                made[name] = _seven(self.task.goal(self._step))
            else:
                value = getattr(state, name)
                limited = np.clip(value, -_LARGEST, _LARGEST) if name in _NUMBERS else value
                made[name] = np.asarray(limited, space.dtype).reshape(space.shape)
        self._late.append(made)
        return {name: value.copy() for name, value in self._late[0].items()}


def _require_observable(scene: Scene) -> None:
    """Refuse observations that a scene cannot give.

    Raises:
        SceneError: with the first of them.
    """
    for name in scene.episode.observe:
        if name in ("wrench", "displacement", "strain") and scene.tissue is None:
            raise SceneError(
                f"{scene.origin}: episode.observe: {name} needs `tissue`, and it is missing: leave "
                f"{name} out, or name a scene with tissue"
            )


def _checked(action: ArrayLike) -> NDArray[np.float64]:
    try:
        numbers = np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise EpisodeError(f"the action {action!r} is no array of numbers") from error
    if numbers.shape != (6,):
        raise EpisodeError(f"the action has shape {numbers.shape}: give six numbers from -1 to 1")
    for number in numbers.tolist():
        if math.isnan(number) or not abs(number) <= 1.0 + 1e-6:
            raise EpisodeError(
                f"the action has {number:g} in {numbers.tolist()}: give six numbers from -1 to 1"
            )
    return np.clip(numbers, -1.0, 1.0)


def _numbers(*shape: int) -> spaces.Box:
    return spaces.Box(-_LARGEST, _LARGEST, shape, np.float32)


def _seven(pose: Pose) -> NDArray[np.float32]:
    """Position (m) and quaternion x, y, z, w."""
    return np.concatenate([pose.position, pose.orientation]).astype(np.float32)
