"""An environment for robots and learners: a scene without ROS, tasks, agents, data sets.

Importing it adds the tasks to gymnasium's environments, as
``gymnasium.make("us_sim.environment:us_sim/FindVein-v0")`` does by itself.
"""

from __future__ import annotations

TASK_NAMES = ("FindVein", "CompressVein", "HoldContact", "FollowPlane")

try:
    from gymnasium.envs.registration import register
except ModuleNotFoundError as error:  # the rest of this room works without
    if (error.name or "").partition(".")[0] != "gymnasium":
        raise
else:
    for _task in TASK_NAMES:
        _entry = "us_sim.environment.environment:ScanEnvironment"
        register(f"us_sim/{_task}-v0", _entry, kwargs={"task": _task})
