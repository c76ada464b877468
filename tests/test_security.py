"""The security policy is what the table of topics says, with an enclave for every process."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import security

from us_sim.run.plan import NodeProcess, enclave_of

ROOT = Path(__file__).resolve().parents[1]


def test_the_policy_is_what_the_code_says():
    assert security.FILE.read_text(encoding="utf-8") == security.policy(), (
        "config/policy.xml is not what the code says: run `python docs/security.py`"
    )


def test_every_executable_has_an_enclave_of_its_own():
    setup = (ROOT / "setup.py").read_text(encoding="utf-8")
    executables = re.findall(r'^    "(?:nodes|viewer)\.(\w+)",$', setup, re.MULTILINE)
    root = ET.fromstring(security.policy())
    enclaves = {enclave.get("path"): enclave for enclave in root.iter("enclave")}
    assert len(executables) > 10
    assert set(enclaves) == {enclave_of(node) for node in (*executables, "session_control")}
    for node in executables:
        profile, *parts = enclaves[enclave_of(node)].iter("profile")
        assert bool(parts) == (node == "composed")  # whose nodes share its process
        assert (profile.get("ns"), profile.get("node")) == ("/", node)
    assert NodeProcess("viewer").arguments()[:3] == ["--ros-args", "--enclave", "/us_sim/viewer"]


def test_a_node_may_do_what_it_does_and_no_more():
    root = ET.fromstring(security.policy())
    profile = next(each for each in root.iter("profile") if each.get("node") == "skin_deformer")
    allowed = {
        (action, name.text)
        for group in profile
        for action in group.keys()  # noqa: SIM118 (an Element's keys are its attributes)
        for name in group
    }
    ours = {"skin/mesh", "skin/nodes", "skin/marker", "diagnostics"}
    assert allowed == {
        *(("publish", topic) for topic in (*ours, "/rosout", "/parameter_events")),
        *(("subscribe", topic) for topic in ("probe/pose", "/clock", "/parameter_events")),
        ("reply", "~/*"),
    }
