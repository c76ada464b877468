"""A gymnasium environment: a hand or a robot arm that scans a patient of soft tissue."""

from __future__ import annotations

import copy
import dataclasses
from collections import deque
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from us_sim.environment.simulation import EpisodeDraw, ScanSimulation, ScanState
from us_sim.environment.tasks import TASKS
from us_sim.errors import EpisodeError, SceneError
from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import exp
from us_sim.scene.reading import merge_documents, parse_scene, read_scene_document
from us_sim.scene.scene import CASE_PREFIX, Scene
from us_sim.settings.spelling import describe_unknown
from us_sim.tracking.robot import clip_to_reach, compute_approach_speed

DEFAULT_SCENE = "upper_arm_learning"

_SENSOR = np.array([100.0, 100.0, 100.0, 10.0, 10.0, 10.0], np.float32)
"""N, N m: range of the sensor of the wrench."""
_FARTHEST = 0.1
"""m: range of the observed displacement of tissue."""
_EPISODE = ("draw", "task", "_step", "_done", "_late")
"""Attributes of an environment that belong to the episode."""

Observation = dict[str, NDArray[Any]]


def resolve_scene(
    scene: str | Scene | None = None,
    case: str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Scene:
    """Read the scene of a name or file, or of a case, and change its keys.

    Args:
        scene: name or file, or a scene, which is returned; default: `DEFAULT_SCENE`.
        case: name or folder.
        settings: keys of a scene, as its YAML has them; NumPy's numbers are numbers.

    Raises:
        EpisodeError: both a scene and a case are given.
        SceneError: the scene cannot be used; one sentence with file and key.
    """
    if scene is not None and case is not None:
        raise EpisodeError(f"scene {scene} and case {case} are both given: name one of them")
    if isinstance(scene, Scene):
        return scene
    name = f"{CASE_PREFIX}{case}" if case is not None else scene or DEFAULT_SCENE
    document, folders, origin = read_scene_document(name)
    if settings:
        document = merge_documents(document, _convert_numpy(settings))
    return parse_scene(document, origin=origin, folders=folders)


class ScanEnvironment(gymnasium.Env[Observation, NDArray[np.float32]]):
    """One task in one scene; docs/learning.md explains its actions and observations.

    Args:
        task: a name in `TASKS`.
        scene, case, settings: as `resolve_scene`.
        render_mode: ``rgb_array``, the image; or None.

    Raises:
        EpisodeError: there is no such task or render mode.
        SceneError: the scene cannot be used, or not for this task, or cannot give an observation
            that it asks for.

    Examples:
        >>> import gymnasium, us_sim.environment
        >>> arm = gymnasium.make("us_sim/FindVein-v0", scene="tests/small_scene.yaml")
        >>> observation, info = arm.reset(seed=1)
        >>> observation["image"].shape, observation["wrench"].shape
        ((80, 96, 1), (6,))
        >>> observation, reward, terminated, truncated, info = arm.step(arm.action_space.sample())
        >>> arm.close()
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as gymnasium's own
        "render_modes": ["rgb_array"],
        "render_fps": 30,
        "autoreset_mode": AutoresetMode.DISABLED,
    }
    _spec: EnvSpec | None = None

    def __init__(
        self,
        task: str = "FindVein",
        scene: str | Scene | None = None,
        case: str | None = None,
        settings: Mapping[str, Any] | None = None,
        render_mode: str | None = None,
    ) -> None:
        if task not in TASKS:
            raise EpisodeError(f"task {describe_unknown(task, TASKS)}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise EpisodeError(f"render_mode {describe_unknown(str(render_mode), ['rgb_array'])}")
        self.render_mode = render_mode
        self.scene = resolve_scene(scene, case, settings)
        self._task_class = TASKS[task]
        self._settings = episode = self.scene.episode
        _require_observable(self.scene)
        self.metadata = {**self.metadata, "render_fps": round(1 / episode.period)}
        self.simulation = ScanSimulation(self.scene)
        self.task = self._task_class(self.simulation)  # refused now rather than at a reset
        self.draw = EpisodeDraw()
        self._truth: ScanState | None = None
        self._step = 0
        self._done = 0.0  # part of the task
        self.action_space = spaces.Box(-1.0, 1.0, (6,), np.float32)
        rows, columns = self.simulation.scanner.probe.rows, self.simulation.scanner.probe.columns
        # A tracker's noise leads beyond the reach.
        margin = 6 * np.array(episode.draws.position_noise[1])
        low = np.array([-episode.aside, -episode.aside, -episode.lift]) - margin
        high = np.array([episode.aside, episode.aside, episode.press]) + margin
        entries: dict[str, Any] = {
            "image": spaces.Box(0, 255, (rows, columns, 1), np.uint8),
            "labels": spaces.Box(0, 255, (rows, columns, 1), np.uint8),
            "displacement": spaces.Box(-_FARTHEST, _FARTHEST, (rows, columns, 2), np.float32),
            "strain": spaces.Box(-1.0, 1.0, (rows, columns, 1), np.float32),
            "wrench": spaces.Box(-_SENSOR, _SENSOR, dtype=np.float32),
            "contact": spaces.Box(0.0, 1.0, (1,), np.float32),
        }
        lowest, highest = np.append(low, [-1.0] * 4), np.append(high, [1.0] * 4)
        placed = spaces.Box(lowest.astype(np.float32), highest.astype(np.float32))
        entries["pose"] = entries["goal"] = placed
        names = (*episode.observe, *(("goal",) if self.task.has_goal else ()))
        self._spaces = {name: entries[name] for name in names}
        self.observation_space: Any = spaces.Dict(self._spaces)

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]
        """Entry in gymnasium's registry, with the number of steps of an episode."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        steps = self._settings.steps
        self._spec = spec and dataclasses.replace(spec, max_episode_steps=steps)

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
        for name, value in _convert_numpy(options or {}).items():
            if name not in vars(draws):
                raise SceneError(f"options: {describe_unknown(name, vars(draws))}")
            given[name] = value if isinstance(value, list) else (value, value)
        self.draw = EpisodeDraw.sample_values(
            dataclasses.replace(draws, **given), self.scene, self.np_random
        )
        self.simulation.reset(self.draw)
        self.task = self._task_class(self.simulation)
        self._step, self._done = 0, 0.0
        self._late: deque[Observation] = deque(maxlen=self.draw.delay + 1)
        start = clip_to_reach(self.draw.start, Pose(), self._settings)
        self._truth = self.simulation.step(start)
        self.task.begin_episode(self._truth)
        return self._observe(), self._make_info()

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move the probe for one period.

        Args:
            action: (6,) -1 to 1: linear, then angular velocity in the probe's frame, over ``speed``
                and ``angular_speed`` of the settings. With ``control: force`` the third asks for
                a force, from none at -1 to ``force`` at 1.

        Raises:
            EpisodeError: the action is no six numbers from -1 to 1, or no episode has begun.
        """
        before = self.truth
        velocity = self._compute_velocity(_check_action(action))
        moved = before.pose @ exp(velocity * self._settings.period)
        self._truth = self.simulation.step(clip_to_reach(moved, before.pose, self._settings))
        self._step += 1
        reward, done = self.task.judge_step(self._truth)
        reward = reward / self._settings.steps + done - self._done
        self._done = done
        is_done = done == 1.0
        truncated = not is_done and self._step >= self._settings.steps
        return self._observe(), reward, is_done, truncated, self._make_info()

    def render(self) -> Any:
        """Return the image (rows, columns, 3), red, green and blue; None without a render mode.

        Raises:
            EpisodeError: no episode has begun.
        """
        if self.render_mode is None:
            return None
        return np.repeat(self.truth.image[..., None], 3, axis=2)

    @property
    def truth(self) -> ScanState:
        """State of the simulation after the last step.

        Raises:
            EpisodeError: no episode has begun.
        """
        if self._truth is None:
            raise EpisodeError("no episode has begun: call reset first")
        return self._truth

    def state(self) -> dict[str, Any]:
        """Copy all that decides what follows, so that `restore` can go on from here.

        Raises:
            EpisodeError: no episode has begun.
        """
        kept = {"simulation": self.simulation.state(), "_truth": self.truth}
        kept["_np_random"] = copy.deepcopy(self.np_random)
        return kept | {name: copy.copy(getattr(self, name)) for name in _EPISODE}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from a state of this environment, as often as needed."""
        self.simulation.restore(state["simulation"])
        self._truth, self.np_random = state["_truth"], copy.deepcopy(state["_np_random"])
        for name in _EPISODE:
            setattr(self, name, copy.copy(state[name]))

    def translate_twist(self, action: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the action that moves the probe as one of the `twist` control would.

        With the `force` control it asks for the force that leads to the same velocity. A probe
        that feels no force cannot be moved away.
        """
        settings, translated = self._settings, action.copy()
        if settings.control == "force":
            wanted = self.truth.force + action[2] * settings.force_error
            translated[2] = np.clip(2 * wanted / settings.force - 1, -1, 1)
        return translated

    def _make_info(self) -> dict[str, Any]:
        force = self.truth.force
        return {
            "is_success": self._done == 1.0,
            "force": force,
            "cost": max(force - self._settings.force, 0.0),
            "is_balanced": self.truth.is_balanced,
            "draw": self.draw.to_document(),
            **self.task.collect_facts(),
        }

    def _compute_velocity(self, action: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the velocity (6,) m/s and rad/s that an action asks for, frame ``probe``."""
        settings = self._settings
        velocity = action * np.repeat([settings.speed, settings.angular_speed], 3)
        if settings.control == "force":
            wanted = 0.5 * (action[2] + 1.0) * settings.force
            damping = settings.force_error / settings.speed
            velocity[2] = compute_approach_speed(wanted, self.truth.force, damping, settings.speed)
        return velocity

    def _observe(self) -> Observation:
        state, draw, observation = self.truth, self.draw, {}
        # Drawn always, so that the choice of observations changes no later random number.
        noise = self.np_random.standard_normal(6)
        noise *= np.repeat([draw.position_noise, draw.orientation_noise], 3)
        for name, space in self._spaces.items():
            if name == "pose":
                value: Any = _pack_pose(state.pose @ exp(noise))
            elif name == "goal":
                value = _pack_pose(self.task.compute_goal(self._step))
            else:
                value = getattr(state, name)
            limited = np.asarray(value, space.dtype).reshape(space.shape)
            observation[name] = limited.clip(space.low, space.high)
        self._late.append(observation)
        return {name: value.copy() for name, value in self._late[0].items()}


def _require_observable(scene: Scene) -> None:
    """Raise SceneError for an observation that the scene cannot give."""
    for name in scene.episode.observe:
        if name in ("wrench", "displacement", "strain") and scene.tissue is None:
            raise SceneError(
                f"{scene.origin}: episode.observe: {name} needs `tissue`, and it is missing: leave "
                f"{name} out, or name a scene with tissue"
            )


def _check_action(action: ArrayLike) -> NDArray[np.float64]:
    try:
        numbers = np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise EpisodeError(f"the action {action!r} is no array of numbers") from error
    if numbers.shape != (6,) or not (np.abs(numbers) <= 1.0 + 1e-6).all():
        raise EpisodeError(f"the action {numbers.tolist()} is not six numbers from -1 to 1")
    return np.clip(numbers, -1.0, 1.0)


def _pack_pose(pose: Pose) -> NDArray[np.float64]:
    """Return position (m) and quaternion x, y, z, w."""
    return np.concatenate([pose.position, pose.orientation])


def _convert_numpy(value: Any) -> Any:
    """Return the value with NumPy's numbers and arrays as Python's numbers and lists."""
    if isinstance(value, Mapping):
        return {key: _convert_numpy(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_convert_numpy(each) for each in value]
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value
