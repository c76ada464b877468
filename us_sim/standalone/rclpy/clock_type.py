"""The kinds of time that a clock can tell."""

from enum import IntEnum


class ClockType(IntEnum):
    """ROS_TIME follows the topic /clock when the parameter use_sim_time is true."""

    UNINITIALIZED = 0
    ROS_TIME = 1
    SYSTEM_TIME = 2
    STEADY_TIME = 3
