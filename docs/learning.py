"""Train the linear policy by CMA-ES, and compare it with the written agent and with chance.

pip install cma && python docs/learning.py

It draws docs/learning.png, and prints the table of docs/learning.md. Training draws where the probe
starts, and the comparison everything. It takes some ten minutes on one core.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cma
import numpy as np
from matplotlib.figure import Figure

from us_sim.environment.agents import FEATURES, LinearPolicy, VisualServo
from us_sim.environment.environment import ScanEnvironment
from us_sim.progress import Progress

FOLDER = Path(__file__).parent
GENERATIONS, POPULATION, EACH, TESTS, STEPS = 16, 8, 1, 24, 100
SAME = {"thickness": 1.0, "speckle": 1, "stiffness": 1.0, "lumen_pressure": 1.0}
SETTINGS = {
    "tissue": {"solver": "fem"},
    "probe": {"image": [128, 128]},
    "episode": {"steps": STEPS},
}


class Chance:
    """Acts at random."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)

    def act(self, _: Any) -> Any:
        """(6,) any action."""
        return self._random.uniform(-1.0, 1.0, 6)


def score(environment: ScanEnvironment, agent: Any, seed: int, options: Any) -> tuple[float, bool]:
    """The return of an episode, and whether the task was done."""
    observation, _ = environment.reset(seed=seed, options=options)
    total, done, truncated = 0.0, False, False
    while not (done or truncated):
        observation, reward, done, truncated, _ = environment.step(agent.act(observation))
        total += reward
    return total, done


def main() -> None:
    """Train, compare, draw."""
    environment = ScanEnvironment("FindVein", settings=SETTINGS)
    search = cma.CMAEvolutionStrategy(
        np.zeros(2 * len(FEATURES)), 1.0, {"popsize": POPULATION, "seed": 1, "verbose": -9}
    )
    means, bests = [], []
    with Progress("training", GENERATIONS, "generations") as bar:
        for generation in range(GENERATIONS):
            seeds = range(1000 + EACH * generation, 1000 + EACH * (generation + 1))
            asked = search.ask()
            returns = [
                np.mean([score(environment, LinearPolicy(w), s, SAME)[0] for s in seeds])
                for w in asked
            ]
            search.tell(asked, [-value for value in returns])
            means.append(float(np.mean(returns)))
            bests.append(float(np.max(returns)))
            bar.update(generation + 1, f"return {means[-1]:.2f}, best {bests[-1]:.2f}")
    weights = search.result.xfavorite
    agents = {
        "random": Chance,
        "linear, by CMA-ES": lambda _: LinearPolicy(weights),
        "written": lambda _: VisualServo(press=False),
    }
    found: dict[str, list[tuple[float, bool]]] = {name: [] for name in agents}
    with Progress("comparing", TESTS, "episodes") as bar:
        for seed in range(TESTS):  # all agents with the same draws
            for name, make in agents.items():
                found[name].append(score(environment, make(seed), seed, None))
            bar.update(seed + 1)
    print("| agent | return: mean, lowest | done |\n| --- | --- | --- |")
    for name, results in found.items():
        returns, done = np.array([r for r, _ in results]), sum(d for _, d in results)
        print(f"| {name} | {returns.mean():.2f}, {returns.min():.2f} | {done} of {TESTS} |")
    print(json.dumps({"weights": np.round(weights, 3).tolist()}))

    figure = Figure(figsize=(8, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    episodes = POPULATION * EACH * np.arange(1, GENERATIONS + 1)
    left.plot(episodes, means, label="mean of a generation")
    left.plot(episodes, bests, label="its best")
    for name, style in (("random", ":"), ("written", "--")):
        value = np.mean([r for r, _ in found[name]])
        left.axhline(value, color="black", ls=style, lw=1, label=name)
    left.set(xlabel="episodes of training", ylabel="return", title="FindVein, linear policy")
    left.legend(fontsize=7)
    for name, results in found.items():
        ordered = np.sort([r for r, _ in results])
        right.plot(ordered, np.linspace(0, 1, len(ordered)), label=name)
    right.set(xlabel="return", ylabel="part of test episodes below", title="other arms")
    right.legend(fontsize=7)
    figure.savefig(FOLDER / "learning.png", dpi=100)


if __name__ == "__main__":
    main()
