"""How often the truth is inside the stated intervals: presses with noise, fitted one by one.

``python tests/tissue/stiffness_coverage.py 100 [--correlation R] [--mesh X Y Z]
[--scene SCENE]``; with ``--mesh`` the fitted tissue has another mesh than the one that made the
forces. Without a scene the tissue is a block of two layers.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from known_press import arm, arm_press, block_press, layered_block

from us_sim.tissue.identification.press_model import PressedTissue
from us_sim.tissue.identification.press_record import choose_poses
from us_sim.tissue.identification.settings import StiffnessSettings
from us_sim.tissue.identification.stiffness import Tissue, fit_stiffness


def main() -> None:
    """Print errors, widths and coverage."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=int)
    parser.add_argument("--noise", type=float, default=0.01)
    parser.add_argument("--correlation", type=float, default=0.0)
    parser.add_argument("--mesh", type=int, nargs=3)
    parser.add_argument("--scene")
    parser.add_argument("--fit", nargs="+", help="structures; of the block both")
    parser.add_argument("--poses", type=int, default=48)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    press = arm_press(args.scene) if args.scene else block_press()
    tissue = press.tissue
    if args.mesh:
        nodes = tuple(args.mesh)
        tissue = arm(args.scene, nodes) if args.scene else layered_block(nodes)
    names = args.fit or list(press.moduli)
    keep = tuple(name for name in press.moduli if name not in names)
    settings = StiffnessSettings(keep=keep, poses=args.poses)
    random = np.random.default_rng(args.seed)
    chosen = choose_poses(
        press.record(press.felt), PressedTissue(tissue.model).clearance, settings.poses
    )
    errors, inside, factors = [], [], []
    began = time.monotonic()
    for run in range(args.runs):
        record = press.record(press.noisy(args.noise, random, args.correlation))
        guess = {name: press.moduli[name] * np.exp(random.uniform(-0.7, 0.7)) for name in names}
        start = Tissue(tissue.model, tissue.materials_for, {**press.moduli, **guess})
        found = fit_stiffness(start, record, settings, chosen=chosen)
        errors.append([found.moduli[name] / press.moduli[name] - 1 for name in names])
        its = [found.intervals[name] for name in names]
        factors.append([each.factor - 1 for each in its])
        pairs = zip(its, names, strict=True)
        inside.append([each.lower <= press.moduli[name] <= each.upper for each, name in pairs])
        print(
            f"{run + 1}: {np.round(100 * np.array(errors[-1]), 2)} % off, intervals ± "
            f"{np.round(100 * np.array(factors[-1]), 2)} %, {found.scatter('force'):.3f} N, "
            f"{found.fitted.steps} steps, {time.monotonic() - began:.0f} s",
            flush=True,
        )
    off = 100 * np.array(errors)
    print(f"{names}: of {args.runs} runs {np.sum(inside, axis=0)} inside the interval")
    print(f"off by {np.sqrt((off**2).mean(axis=0))} % RMS, {abs(off).max(axis=0)} % at most")
    print(f"mean {off.mean(axis=0)} %; half widths {100 * np.median(factors, axis=0)} % median")


if __name__ == "__main__":
    main()
