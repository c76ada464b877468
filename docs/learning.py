"""Train agents by PPO to compress the vein, and compare them with the written one and with chance.

pip install '.[baselines]' && python docs/learning.py [SEED ...]

It draws docs/learning.png, and prints the table of docs/learning.md. Training draws where the probe
starts on one arm, and the comparison everything. A seed takes some five minutes on one core.
"""

from __future__ import annotations

import argparse
from functools import partial
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
from us_sim.progress import ProgressBar

FOLDER = Path(__file__).parent
TRAINING, TESTS, STEPS = 40_000, 24, 150
HOLD = 4
"""Steps for which an action lasts: in one the probe moves by 1 mm at most, which pays little."""
ONE_ARM = {"thickness": 1.0, "speckle": 1, "stiffness": 1.0, "lumen_pressure": 1.0}
SETTINGS = {
    "tissue": {"solver": "fem"},
    "probe": {"image": [128, 128]},
    "episode": {"steps": STEPS},
}


class Senses(gymnasium.Wrapper[Any, Any, Any, Any]):
    """What PPO sees and does: seven numbers, and velocities along x and z.

    The numbers are offset and area of the largest dark spot, contact, force, depth, and as memory
    the largest force so far, and the velocity along z.
    """

    def __init__(
        self, environment: gymnasium.Env[Any, Any], options: dict[str, Any] | None
    ) -> None:
        super().__init__(environment)
        self._options = options
        self.observation_space = Box(-10.0, 10.0, (7,), np.float32)
        self.action_space = Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode, and the memory."""
        observation, info = self.env.reset(seed=seed, options=options or self._options)
        self._largest, self._most = 1.0, 0.0
        return self._sense(observation, 0.0), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Move along x and z for `HOLD` steps."""
        (x, z), total = np.clip(action, -1.0, 1.0).tolist(), 0.0
        for _ in range(HOLD):
            observation, reward, *ends, info = self.env.step([x, 0, z, 0, 0, 0])
            seen, total = self._sense(observation, z), total + float(reward)
            if any(ends):
                break
        return seen, total, *ends, info

    def _sense(self, observation: Any, z: float) -> Any:
        image = observation["image"][..., 0]
        spots = find_dark_spots(image)
        area = spots[0].area if spots else 0.0
        offset = 10.0 * (spots[0].centre[0] / (image.shape[1] - 1) - 0.5) if spots else 0.0
        touch, depth = float(observation["contact"][0]), 100.0 * float(observation["pose"][2])
        force = -float(observation["wrench"][2]) / 10.0
        self._largest, self._most = max(self._largest, area), max(self._most, force)
        seen = [offset, area / self._largest, touch, force, depth, self._most, z]
        return np.clip(seen, -10.0, 10.0).astype(np.float32)


def choose_action(model: PPO, seen: Any) -> Any:
    """Return the action of a policy, without the noise of its training."""
    return model.predict(seen, deterministic=True)[0]


def score(environment: Any, act: Any, seed: int) -> tuple[float, bool]:
    """Return the return of an episode, and whether the task was done."""
    observation, _ = environment.reset(seed=seed)
    total, done, truncated = 0.0, False, False
    while not (done or truncated):
        observation, reward, done, truncated, _ = environment.step(act(observation))
        total += reward
    return total, done


def train_policy(environment: ScanEnvironment, seed: int) -> tuple[PPO, Monitor[Any, Any]]:
    """Train on one arm; return the policy, and the lengths and returns of its episodes."""
    arm = Monitor(environment)
    # What is undone takes its pay back. With a discount near 1 it hardly matters then how long the
    # vein stays pressed, and a policy that always presses has nothing to gain by a step upwards.
    rates = {"gamma": 0.9, "learning_rate": 1e-3}
    model = PPO("MlpPolicy", Senses(arm, ONE_ARM), n_steps=250, batch_size=50, seed=seed, **rates)
    with ProgressBar(f"training, seed {seed}", TRAINING, "steps") as bar:

        def show(now: dict[str, Any], _: Any) -> bool:
            bar.update(HOLD * now["self"].num_timesteps)
            return True

        model.learn(TRAINING // HOLD, callback=show)
    return model, arm


def main() -> None:
    """Train, compare, draw."""
    parser = argparse.ArgumentParser(description="Train agents by PPO, and compare them.")
    parser.add_argument("seeds", metavar="SEED", nargs="*", type=int, default=range(1, 7))
    seeds = parser.parse_args().seeds
    environment = ScanEnvironment("CompressVein", settings=SETTINGS)
    new_arms, random = Senses(environment, None), np.random.default_rng(0)
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))

    def compare(name: str, arms: Any, acts: list[Any]) -> None:
        results = []
        with ProgressBar(f"testing {name}", TESTS, "episodes") as bar:
            for seed, act in enumerate(acts):  # all agents with the same draws
                results.append(score(arms, act, seed))
                bar.update(seed + 1)
        returns, done = np.sort([r for r, _ in results]), sum(d for _, d in results)
        print(
            f"| {name} | {returns.mean():.2f}, {returns[0]:.2f} | {done} of {TESTS} |", flush=True
        )
        right.plot(returns, np.linspace(0, 1, TESTS), label=name)

    print("| agent | return: mean, lowest | done |\n| --- | --- | --- |")
    compare("random", new_arms, [lambda _: random.uniform(-1, 1, 2)] * TESTS)
    for seed in seeds:
        model, arm = train_policy(environment, seed)
        mean = np.convolve(arm.get_episode_rewards(), np.full(20, 1 / 20), "valid")
        left.plot(np.cumsum(arm.get_episode_lengths())[19:], mean, label=f"seed {seed}")
        act = partial(choose_action, model)
        compare(f"PPO, seed {seed}", new_arms, [act] * TESTS)
    compare("written", environment, [VisualServo().act for _ in range(TESTS)])
    left.set(xlabel="steps of training", ylabel="return, mean of 20 episodes", title="one arm")
    right.set(xlabel="return", ylabel="part of test episodes up to it", title="other arms")
    left.legend(fontsize=7)
    right.legend(fontsize=7)
    figure.savefig(FOLDER / "learning.png", dpi=100)


if __name__ == "__main__":
    main()
