"""Arguments of ROS among those of a command."""

import pytest

from us_sim.errors import UsSimError
from us_sim.run.domain import get_namespace, get_ros_arguments, take_ros_arguments


def test_arguments_of_ros_are_taken_from_a_command_for_all_nodes():
    given = ["run", "arm", "--ros-args", "-r", "__ns:=/a", "--", "-x"]
    assert take_ros_arguments(given) == ["run", "arm", "-x"]
    assert (get_ros_arguments(), get_namespace()) == (["-r", "__ns:=/a"], "/a")
    assert (take_ros_arguments([]), get_ros_arguments(), get_namespace()) == ([], [], "/")


@pytest.mark.parametrize("rule", ["__node:=a", "__name:=a"])
def test_one_name_for_all_nodes_is_refused(rule):
    with pytest.raises(UsSimError, match="one name"):
        take_ros_arguments(["run", "arm", "--ros-args", "-r", rule])
