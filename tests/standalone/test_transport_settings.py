"""Domains, discovery ranges and quality of service, from the environment and from profiles."""

import doctest
import importlib
import os
import shutil
import subprocess
import sys
from types import SimpleNamespace

import pytest

pytest.importorskip("cyclonedds", reason="the transport needs pip install cyclonedds")

from transport_bench import LOCALHOST

from us_sim.standalone.ddsc import EndpointQos, qos_of_profile
from us_sim.standalone.transport import DdsError, DiscoveryRange, Participant


@pytest.mark.usefixtures("participant")
def test_one_process_cannot_reach_two_ways_in_a_domain(domain):
    with pytest.raises(DdsError, match="discovery range LOCALHOST"):
        Participant(domain, reach=DiscoveryRange("SUBNET"))


@pytest.mark.parametrize("number", [-1, 233])
def test_a_domain_that_does_not_exist_is_refused(number):
    with pytest.raises(DdsError, match="not one of 0 to 232"):
        Participant(number, reach=LOCALHOST)


def test_the_environment_decides_the_discovery_range():
    assert DiscoveryRange.from_environment({}) == DiscoveryRange("SUBNET")
    assert DiscoveryRange.from_environment({"ROS_LOCALHOST_ONLY": "1"}).name == "LOCALHOST"
    environment = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF", "ROS_LOCALHOST_ONLY": "0"}
    assert DiscoveryRange.from_environment(environment).name == "OFF"
    with pytest.raises(DdsError, match="SUBNET, LOCALHOST, OFF, SYSTEM_DEFAULT"):
        DiscoveryRange.from_environment({"ROS_AUTOMATIC_DISCOVERY_RANGE": "localhost"})


def test_the_configuration_follows_the_discovery_range():
    localhost = DiscoveryRange("LOCALHOST", ("pc<2>",)).configuration()
    assert "address='127.0.0.1'" in localhost
    assert "<AllowMulticast>false</AllowMulticast>" in localhost
    assert "<Peer address='localhost'/><Peer address='pc&lt;2&gt;'/>" in localhost
    subnet = DiscoveryRange("SUBNET", ("10.0.0.5",)).configuration()
    assert "<Peers><Peer address='10.0.0.5'/></Peers>" in subnet
    assert "AllowMulticast" not in subnet
    off = DiscoveryRange("OFF", ("10.0.0.5",)).configuration()
    assert f"<Tag>ros_discovery_off_{os.getpid()}</Tag>" in off
    assert "Peer" not in off
    assert "Participant" not in DiscoveryRange("SYSTEM_DEFAULT", ("a",)).configuration()


def profile(**changes):
    values = {
        "reliability": 1,
        "durability": 2,
        "history": 1,
        "depth": 10,
        "deadline": SimpleNamespace(nanoseconds=0),
        "lifespan": SimpleNamespace(nanoseconds=0),
        "liveliness": 0,
        "liveliness_lease_duration": SimpleNamespace(nanoseconds=2**63 - 1),
    }
    return SimpleNamespace(**values | changes)


def test_a_profile_of_rclpys_becomes_policies():
    assert qos_of_profile(profile()) == EndpointQos()
    system = profile(reliability=0, durability=0, history=0, depth=0)
    assert qos_of_profile(system) == EndpointQos(depth=1)
    timed = profile(deadline=SimpleNamespace(nanoseconds=5), history=2, liveliness=3)
    assert qos_of_profile(timed) == EndpointQos(deadline=5, history=2, liveliness=3)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"reliability": 3}, "reliability policy 3 cannot be asked for"),
        ({"durability": 3}, "durability policy 3 cannot be asked for"),
        ({"history": 3}, "history policy 3 cannot be asked for"),
        ({"liveliness": 4}, "liveliness policy 4 cannot be asked for"),
        ({"reliability": 4}, "reliability policy 4 cannot be asked for"),
        ({"depth": -1}, "depth of -1"),
    ],
)
def test_an_unknown_policy_is_refused(changes, sentence):
    with pytest.raises(DdsError, match=sentence):
        qos_of_profile(profile(**changes))


@pytest.mark.parametrize("name", ["ddsc", "transport"])
def test_examples(name):
    result = doctest.testmod(importlib.import_module(f"us_sim.standalone.{name}"))
    assert result.attempted > 0
    assert result.failed == 0


def test_a_loopback_without_ipv4_is_named():
    program = "import us_sim.nodes, rclpy; rclpy.init()"
    isolated = ["unshare", "-rn", sys.executable, "-c", program]
    if shutil.which("unshare") is None or subprocess.run(["unshare", "-rn", "true"]).returncode:
        pytest.skip("no network namespaces here")
    ran = subprocess.run(isolated, capture_output=True, text=True, check=False)
    assert "IPv4" in ran.stderr
