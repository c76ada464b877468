"""The robot's node: commands in either frame, a spring that it presses, and what it refuses."""

import math

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped

from us_sim.nodes.messages import wrench_message
from us_sim.nodes.probe_robot import ProbeRobot


def twist(frame="probe", **linear):
    message = TwistStamped()
    message.header.frame_id = frame
    for axis, value in linear.items():
        setattr(message.twist.linear, axis, value)
    return message


@pytest.fixture
def commands(bench):
    node = bench.make(ProbeRobot, rate=200.0, lift=0.005, damping=50.0, timeout=5.0)
    twists = bench.publisher(TwistStamped, "robot/twist")
    forces = bench.publisher(WrenchStamped, "robot/force")
    felt = bench.publisher(WrenchStamped, "probe/wrench")
    return node, twists, forces, felt, bench.collect(PoseStamped, "tracker/pose")


@pytest.mark.parametrize("frame", ["probe", "patient"])
def test_a_velocity_moves_the_probe_from_above_the_patient(bench, commands, frame):
    _, twists, _, _, poses = commands
    bench.spin_until(lambda: bool(poses))
    first = poses[0]
    assert (first.header.frame_id, first.pose.position.z) == ("patient", -0.005)
    twists.publish(twist(frame, x=0.02))
    bench.spin_until(lambda: poses[-1].pose.position.x > 0.01)
    assert poses[-1].pose.position.z == -0.005


def test_a_wanted_force_is_reached_on_a_spring(bench, commands):
    node, _, forces, felt, poses = commands
    no_torque = np.zeros(3)

    def pressed():
        """N, of 500 N/m below the skin."""
        return 500.0 * max(poses[-1].pose.position.z, 0.0) if poses else 0.0

    def is_reached():
        felt.publish(wrench_message(np.array([0, 0, -pressed()]), no_torque, Time(), "probe"))
        forces.publish(wrench_message(np.array([0, 0, 3.0]), no_torque, Time(), "probe"))
        return math.isclose(pressed(), 3.0, rel_tol=0.02)

    bench.spin_until(is_reached)
    assert node.health.state == "seeking 3.0 N"


@pytest.mark.parametrize(
    ("name", "message", "kind"),
    [
        ("robot/twist", twist(x=math.nan), "message"),
        ("robot/twist", twist("camera", x=0.1), "message"),
        (
            "robot/force",
            wrench_message(np.full(3, math.inf), np.zeros(3), Time(), "probe"),
            "message",
        ),
        ("robot/force", wrench_message(np.ones(3), np.zeros(3), Time(), "map"), "frame"),
        ("robot/force", wrench_message(np.full(3, 90.0), np.zeros(3), Time(), "probe"), "force"),
    ],
)
def test_what_cannot_be_done_is_said_and_moves_nothing(bench, commands, name, message, kind):
    node, twists, forces, _, poses = commands
    reports = bench.collect(DiagnosticArray, "diagnostics")
    (twists if name == "robot/twist" else forces).publish(message)
    bench.spin_until(lambda: node.health.problems[kind] == 1)
    before = len(poses)
    bench.spin_until(lambda: len(poses) > before + 5)
    assert {(p.pose.position.x, p.pose.position.z) for p in poses} == {(0.0, -0.005)}
    told = f"rejected {kind}"
    bench.spin_until(
        lambda: any(v.key == told for r in reports for s in r.status for v in s.values)
    )
