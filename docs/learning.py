"""Train an agent by PPO to compress the vein, and compare it with the written one and with chance.

pip install '.[baselines]' && python docs/learning.py

It draws docs/learning.png, and prints the table of docs/learning.md. Training draws where the probe
starts on one arm, and the comparison everything. It takes some five minutes on one core.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from matplotlib.figure import Figure
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor

from us_sim.environment.agents import VisualServo, find_dark_spots
from us_sim.environment.environment import ScanEnvironment
from us_sim.progress import Progress

FOLDER = Path(__file__).parent
TRAINING, TESTS, STEPS = 40_000, 24, 150
ONE_ARM = {"thickness": 1.0, "speckle": 1, "stiffness": 1.0, "lumen_pressure": 1.0}
SETTINGS = {
    "tissue": {"solver": "fem"},
    "probe": {"image": [128, 128]},
    "episode": {"steps": STEPS},
}


class Senses(gymnasium.Wrapper[Any, Any, Any, Any]):
    """What PPO sees and does: eight numbers, and velocities along x and z.

    The numbers are offset and area of the largest dark spot, contact, force, depth, and as memory
    the steps in contact without a dark spot, the largest force so far, and the velocity along z.
    """

    def __init__(self, environment: ScanEnvironment, options: dict[str, Any] | None) -> None:
        super().__init__(environment)
        self._options = options
        self.observation_space = Box(-10.0, 10.0, (8,), np.float32)
        self.action_space = Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode, and the memory."""
        observation, info = self.env.reset(seed=seed, options=options or self._options)
        self._largest, self._gone, self._most = 1.0, 0, 0.0
        return self._sense(observation, 0.0), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Move along x and z."""
        x, z = np.clip(action, -1.0, 1.0).tolist()
        observation, reward, *ends, info = self.env.step([x, 0, z, 0, 0, 0])
        return self._sense(observation, z), float(reward), *ends, info

    def _sense(self, observation: Any, z: float) -> Any:
        image = observation["image"][..., 0]
        spots = find_dark_spots(image)
        area = spots[0].area if spots else 0.0
        offset = 10.0 * (spots[0].centre[0] / (image.shape[1] - 1) - 0.5) if spots else 0.0
        touch, depth = float(observation["contact"][0]), 100.0 * float(observation["pose"][2])
        force = -float(observation["wrench"][2]) / 10.0
        self._largest, self._most = max(self._largest, area), max(self._most, force)
        self._gone += touch > 0.5 and not spots
        memory = self._gone / 10.0, self._most, z
        seen = [offset, area / self._largest, touch, force, depth, *memory]
        return np.clip(seen, -10.0, 10.0).astype(np.float32)


def score(environment: Any, act: Any, seed: int) -> tuple[float, bool]:
    """Return the return of an episode, and whether the task was done."""
    observation, _ = environment.reset(seed=seed)
    total, done, truncated = 0.0, False, False
    while not (done or truncated):
        observation, reward, done, truncated, _ = environment.step(act(observation))
        total += reward
    return total, done


def main() -> None:
    """Train, compare, draw."""
    environment = ScanEnvironment("CompressVein", settings=SETTINGS)
    arm = Monitor(Senses(environment, ONE_ARM), info_keywords=("is_success",))
    # Noise that lasts for some steps presses deeper than noise which is new in each.
    smooth = {"use_sde": True, "sde_sample_freq": 8, "policy_kwargs": {"log_std_init": -1.0}}
    model = PPO("MlpPolicy", arm, n_steps=1000, batch_size=100, seed=1, **smooth)
    with Progress("training", TRAINING, "steps") as bar:

        def show(now: dict[str, Any], _: Any) -> bool:
            bar.update(now["self"].num_timesteps)
            return True

        model.learn(TRAINING, callback=show)
    ends, returns = np.cumsum(arm.get_episode_lengths()), np.array(arm.get_episode_rewards())

    new_arms, random = Senses(environment, None), np.random.default_rng(0)
    found: dict[str, list[tuple[float, bool]]] = {"random": [], "PPO": [], "written": []}
    with Progress("comparing", TESTS, "episodes") as bar:
        for seed in range(TESTS):  # all agents with the same draws
            found["random"].append(score(new_arms, lambda _: random.uniform(-1, 1, 2), seed))
            found["PPO"].append(
                score(new_arms, lambda seen: model.predict(seen, deterministic=True)[0], seed)
            )
            found["written"].append(score(environment, VisualServo().act, seed))
            bar.update(seed + 1)
    print("| agent | return: mean, lowest | done |\n| --- | --- | --- |")
    for name, results in found.items():
        all_returns, done = np.array([r for r, _ in results]), sum(d for _, d in results)
        print(f"| {name} | {all_returns.mean():.2f}, {all_returns.min():.2f} | {done} of {TESTS} |")

    figure = Figure(figsize=(8, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    left.plot(ends, returns, ".", ms=2, color="grey", label="an episode")
    mean = np.convolve(returns, np.full(20, 1 / 20), "valid")
    left.plot(ends[19:], mean, label="mean of 20")
    left.set(xlabel="steps of training", ylabel="return", title="CompressVein, PPO, one arm")
    left.legend(fontsize=7)
    for name, results in found.items():
        ordered = np.sort([r for r, _ in results])
        right.plot(ordered, np.linspace(0, 1, len(ordered)), label=name)
    right.set(xlabel="return", ylabel="part of test episodes below", title="other arms")
    right.legend(fontsize=7)
    figure.savefig(FOLDER / "learning.png", dpi=100)


if __name__ == "__main__":
    main()
