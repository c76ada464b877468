"""Texts that others chose, on the page: they are shown as they are, and none becomes part of it."""

import ast
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from awaiting import until
from fake_hand import FakeHand

import us_sim.viewer

from bench import Bench  # isort: skip
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.qos import LATCHED, STREAM
from us_sim.viewer.remote_parameters import RemoteParameters
from us_sim.viewer.session import ViewerSession
from us_sim.viewer.status import StatusListener
from us_sim.viewer.stream import CallPoster, PageSources

EVIL = " ".join(
    (
        'x" innerHTML="<img src=q onerror=window.XSS=1>" :title="window.XSS=1" y="',
        "<img src=q onerror=window.XSS=1><script>window.XSS=1</script>",
        "'; window.XSS=1; // ${window.XSS=1} `; window.XSS=1; //",
        '{{ constructor.constructor("window.XSS=1")() }}',
    )
)
"""Breaks out of attributes, elements, scripts and templates where one is made of it as text."""
BROKEN_OUT = "window.XSS || document.querySelectorAll('img[src=q]').length"
NODES = ("slice_interpolator", "tissue_deformer")


def status_of(name: str, **values: str) -> DiagnosticStatus:
    status = DiagnosticStatus(name=name, hardware_id=EVIL, message=EVIL)
    status.level = DiagnosticStatus.OK
    status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
    return status


@pytest.fixture
def stranger(sources: PageSources) -> Iterator[None]:
    """Somebody on the graph who says all that nodes say of themselves, with hostile texts."""
    bench = Bench()
    viewer = bench.add(GuardedNode("viewer", context=bench.context))
    post = CallPoster(viewer)
    sources.session = ViewerSession(viewer, post)
    sources.nodes = RemoteParameters(viewer)
    sources.status = StatusListener(viewer, post)
    for name in NODES:
        node = bench.add(Node(name, context=bench.context))
        about = ParameterDescriptor(
            description=EVIL,
            additional_constraints=json.dumps({"choices": {"a": EVIL, EVIL: EVIL}, "unit": EVIL}),
        )
        for parameter in ("solver", "materials.x.young_modulus", EVIL):
            node.declare_parameter(parameter, EVIL, about)
    foreign = bench.add(Node("foreign", context=bench.context))

    def array(*statuses: DiagnosticStatus) -> DiagnosticArray:
        return DiagnosticArray(status=list(statuses))

    about = {"kind": "case", "region": EVIL, "structures": json.dumps([EVIL]), "tracker": EVIL}
    for topic in ("session/scenes", "session/bags"):
        message = array(status_of(EVIL, **about), status_of("plain", **about | {"kind": EVIL}))
        foreign.create_publisher(DiagnosticArray, topic, LATCHED).publish(message)
    told = {"state": EVIL, "scene": EVIL, "record": EVIL, "record_note": EVIL, "replay": EVIL}
    control = status_of("/session_control", **told, origin="plain", replay_state=EVIL)
    control.level = DiagnosticStatus.WARN
    nodes = [status_of(f"/{name}", state=EVIL, compared_with=EVIL) for name in NODES]
    diagnostics = foreign.create_publisher(DiagnosticArray, "diagnostics", STREAM)
    said = array(control, status_of(EVIL, state=EVIL), *nodes)
    foreign.create_timer(0.2, lambda: diagnostics.publish(said))
    ended = threading.Event()

    def spin() -> None:
        while not ended.is_set():
            bench.executor.spin_once(timeout_sec=0.05)

    spinning = threading.Thread(target=spin)
    spinning.start()
    yield
    ended.set()
    spinning.join()
    bench.close()


@pytest.mark.usefixtures("stranger")
def test_no_text_of_others_becomes_part_of_the_page(page: Any, sources: PageSources) -> None:
    hand = FakeHand(sources)
    hand.say(leader="nobody", obstacle=EVIL, warning=EVIL)
    page.goto(page.address)
    page.locator("#us-panels").click()
    shown = {
        "Cases": ".us-case",
        "Session": ".us-session",
        "Image": ".us-control",
        "Tissue": ".us-control",
        "Status": ".us-status tbody",
    }
    for tab, marks in shown.items():
        page.get_by_role("tab", name=tab).click()
        page.locator(marks).locator("visible=true").first.wait_for()
        if tab == "Cases":
            button = page.locator(".us-case button").first
            until(lambda b=button: b.get_attribute("aria-label") == f"Load {EVIL}", "as it is")
        if tab == "Status":
            page.locator(".us-status button").first.click()
            page.get_by_role("dialog").wait_for()
        assert not page.evaluate(BROKEN_OUT), tab
    page.evaluate(
        "name => import('/us_sim/assets/events.js').then(m => m.events.tell('structures',"
        " [{name, colour: name, isShown: true}]))",
        EVIL,
    )
    page.locator(".us-parts label", has_text="onerror").wait_for(state="attached")
    assert page.locator(".us-said").text_content() == EVIL
    assert not page.evaluate(BROKEN_OUT)


@pytest.mark.parametrize("method", ["props", "classes", "style"])
def test_what_is_parsed_is_never_made_of_a_text(method: str) -> None:
    for file in sorted(Path(us_sim.viewer.__file__).parent.rglob("*.py")):
        for call in ast.walk(ast.parse(file.read_text())):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute):
                arguments = call.args if call.func.attr == method else []
                wrong = [each for each in arguments if not isinstance(each, ast.Constant)]
                assert not wrong, f"{file}:{call.lineno}: set {method} as values"
