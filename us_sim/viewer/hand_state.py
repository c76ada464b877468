"""What pages are told of how the probe is held: the header of the stream ``hand``."""

from __future__ import annotations

from typing import Any

from us_sim.tracking.virtual_hand import DEEPEST, HIGHEST, STEEPEST, RestSurface, Stance


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
        state |= {"stance": _numbers(stance), "goal": _numbers(goal)}
    if surface is not None:
        lower, upper = surface.lower.tolist(), surface.upper.tolist()
        state["range"] = {
            "x": [lower[0], upper[0]],
            "y": [lower[1], upper[1]],
            "press": [-HIGHEST, DEEPEST],
            "tilt": [-STEEPEST, STEEPEST],
        }
    return state


def _numbers(stance: Stance) -> dict[str, float]:
    x, y, z = stance.point.tolist()
    return {
        "x": x,
        "y": y,
        "z": z,
        "press": stance.press,
        "rotation": stance.rotation,
        "fan": stance.fan,
        "rock": stance.rock,
    }
