"""An environment for robots and learners: a scene without ROS, tasks, agents, data sets.

Gymnasium finds its tasks by an entry point, as ``gymnasium.make("us_sim/FindVein-v0")``; without
installing this package, ``import us_sim.environment`` adds them.
"""

from __future__ import annotations

TASK_NAMES = ("FindVein", "CompressVein", "HoldContact", "FollowPlane")


def register() -> None:
    """Add the tasks to gymnasium's environments, once."""
    from gymnasium.envs.registration import register, registry

    for task in TASK_NAMES:
        name = f"us_sim/{task}-v0"
        if name not in registry:
            entry = "us_sim.environment.environment:ScanEnvironment"
            register(name, entry, kwargs={"task": task})


try:
    register()
except ModuleNotFoundError as error:  # the rest of this room works without
    if (error.name or "").partition(".")[0] != "gymnasium":
        raise
