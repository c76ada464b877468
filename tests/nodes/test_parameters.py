"""Parameters: what ROS shows of each setting, what may change, and what a change does."""

import importlib
import json
import math
import threading
from functools import partial
from typing import Any

import pytest
from bench import pose_at
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.parameter import Parameter

from us_sim.errors import UsSimError
from us_sim.nodes.settings import (
    NODES,
    SessionControlSettings,
    check_parameters,
    is_live,
    parameters_of,
)
from us_sim.nodes.tissue_deformer import TissueDeformer
from us_sim.run.plan import NodeProcess
from us_sim.scene.reading import load_scene
from us_sim.settings.quantity import choose_dial_unit
from us_sim.settings.setting import Settings, kinds_of, rules_of
from us_sim.share import shared_path
from us_sim.tissue import live_tissue

BAG = shared_path("bags/press_and_slide.mcap")


@pytest.fixture(scope="module")
def scene(tmp_path_factory, small_scene):
    """The small scene, with blood in a vein and a haptic arm, so that every node can be."""
    file = tmp_path_factory.mktemp("scene") / "all.yaml"
    file.write_text(
        f"based_on: {small_scene}\ntracker: {{source: haptic}}\n"
        "structures: {vein: {flow: {kind: venous, direction: [0, 1, 0], peak_velocity: 0.2, "
        "mean_velocity: 0.07}}}\n"
    )
    return file


def given_to(node: str, scene: Any, folder: Any) -> dict[str, object]:
    own: dict[str, dict[str, object]] = {
        "path_player": {"path": str(BAG)},
        "session_player": {"path": str(BAG)},
        "session_recorder": {"file": str(folder / "session.mcap")},
        "image_writer": {"folder": str(folder / "images")},
        "camera_driver": {"source": "63"},  # a camera that is not there
        "openigtlink_bridge": {"port": 0, "host": "127.0.0.1"},
    }
    of_scene = {"scene": str(scene)} if NODES[node][0].__name__ == "SceneNodeSettings" else {}
    return of_scene | own.get(node, {})


def made(bench, node: str, scene: Any, folder: Any) -> Any:
    module = importlib.import_module(NodeProcess(node).module)
    name = next(n for n in vars(module) if n.lower() == node.replace("_", ""))
    node_class = getattr(module, name)
    if node == "session_control":
        node_class = partial(node_class, print, print, SessionControlSettings())
    return bench.make(node_class, **given_to(node, scene, folder))


def settings_of(node: str, scene: Any) -> list[tuple[str, type[Settings], str]]:
    """Each setting of a node that is a parameter: its name, and where it is said."""
    return [
        (prefix + name, settings, name)
        for prefix, settings in parameters_of(node, scene)
        for name in rules_of(settings)
        if prefix or settings in NODES[node] or is_live(settings, name)
    ]


def plain(kind: Any) -> Any:
    """The type of a number that need not be given, and any other as it is."""
    return next((each for each in (int, float) if kind == each | None), kind)


def attempt(node: Any, name: str, value: object) -> Any:
    return node.set_parameters([Parameter(name, value=value)])[0]


def highest(parameter, rule):
    """The end of a number's range; the image's is where a linear probe hears echoes no more."""
    return 0.115 if parameter == "depth" else rule.quantity.maximum


@pytest.mark.slow
@pytest.mark.parametrize("name", NODES)
def test_every_setting_is_shown_and_only_what_may_change_can_be_set(bench, scene, tmp_path, name):
    node = made(bench, name, scene, tmp_path)
    asked = settings_of(name, load_scene(scene))
    assert asked
    for parameter, settings, field in asked:
        rule, kind = rules_of(settings)[field], plain(kinds_of(settings)[field])
        shown = node.describe_parameter(parameter)
        told = json.loads(shown.additional_constraints)
        assert rule.description, parameter
        assert shown.description == rule.description
        unit, dial = (
            (rule.quantity.unit, choose_dial_unit(rule.quantity)) if rule.quantity else ("", "")
        )
        assert (told.get("unit", ""), told.get("shown_in", "")) == (unit, dial)
        assert told["live"] is is_live(settings, field)
        assert tuple(told.get("choices", ())) == (
            rule.choice.names if rule.choice else rule.choices
        )
        ranges = [*shown.integer_range, *shown.floating_point_range]
        assert len(ranges) == (kind in (int, float) and rule.quantity is not None), parameter
        if ranges:
            low = min(0.0, rule.quantity.minimum) if kind != kinds_of(settings)[field] else None
            assert ranges[0].from_value == (rule.quantity.minimum if low is None else low)
            assert ranges[0].to_value == highest(parameter, rule)
        assert shown.read_only is not is_live(settings, field)
        if shown.read_only:
            value = node.get_parameter(parameter).value
            refused = attempt(node, parameter, value)
            assert not refused.successful
            assert "read-only" in refused.reason


LIVE = ["tissue_deformer", "skin_deformer", "slice_interpolator", "probe_tracker"]


@pytest.mark.parametrize("name", LIVE)
def test_what_may_change_is_taken_in_its_range_and_refused_outside(bench, scene, tmp_path, name):
    node = made(bench, name, scene, tmp_path)
    live = [asked for asked in settings_of(name, load_scene(scene)) if is_live(*asked[1:])]
    assert live
    for parameter, settings, field in live:
        rule, kind = rules_of(settings)[field], plain(kinds_of(settings)[field])
        before = node.get_parameter(parameter).value
        quantity = rule.quantity
        if kind in (int, float):
            low, high = quantity.minimum, highest(parameter, rule)
            for value in (kind(low - abs(low) - 1), kind(high + abs(high) + 1)):
                refused = attempt(node, parameter, value)
                assert not refused.successful, parameter
                assert f"{kind(high)}" in refused.reason
                least = low if kind == kinds_of(settings)[field] else min(low, 0)  # 0 is none
                assert f"Min: {kind(least)}" in refused.reason
        elif quantity is not None:  # a list of numbers
            refused = attempt(node, parameter, [quantity.maximum + 1.0] * len(before))
            assert not refused.successful
            assert f"is outside {quantity.minimum:g} to {quantity.maximum:g}" in refused.reason
        elif rule.choice or rule.choices:
            refused = attempt(node, parameter, "qqqq")
            assert not refused.successful
            assert "'qqqq' is not one of" in refused.reason
        assert node.get_parameter(parameter).value == before
        if kind in (int, float) and field not in ("depth", "focus", "frequency"):
            near = 0.99 * before + 0.01 * quantity.maximum if kind is float else before + 1
            assert attempt(node, parameter, near).successful
            assert node.get_parameter(parameter).value == near
        elif rule.choices:
            assert attempt(node, parameter, rule.choices[-1]).successful


def test_the_depth_of_the_image_may_change_and_its_range_is_said(bench, scene, tmp_path):
    node = made(bench, "slice_interpolator", scene, tmp_path)
    assert attempt(node, "depth", 0.03).successful
    assert attempt(node, "focus", 0.02).successful
    refused = attempt(node, "focus", 0.0005)  # in the range that ROS is told, for 0 is none
    assert not refused.successful
    assert "0.0005 m is outside 0.001 to 0.4 m" in refused.reason
    assert attempt(node, "focus", 0.0).successful


@pytest.fixture
def pressed(bench, small_scene):
    """A node, and what presses it once and returns its force, NaN where it is not in balance."""

    def begin(**parameters: object) -> Any:
        node = bench.make(TissueDeformer, scene=str(small_scene), **parameters)
        wrenches = bench.collect(WrenchStamped, "probe/wrench")
        publisher = bench.publisher(PoseStamped, "probe/pose")
        bench.spin_until(lambda: bench.peer.count_publishers("probe/wrench") > 0)
        turn = iter(range(1, 10_000))

        def press(depth: float = 0.004) -> float:
            count, before = len(wrenches), unbalanced()
            publisher.publish(pose_at(depth, next(turn)))
            bench.spin_until(lambda: len(wrenches) > count or unbalanced() > before)
            return wrenches[-1].wrench.force.z if len(wrenches) > count else math.nan

        def unbalanced() -> int:
            return int(node.health.values.get("unbalanced", "0"))

        return node, press

    return begin


def test_a_solver_s_setting_reaches_it(pressed):
    node, press = pressed(solver="fem_cg", lockstep=True)

    def residual(iterations: int, depth: float) -> float:
        assert attempt(node, "fem_cg.iterations", iterations).successful
        press(depth)
        return float(node.health.values["residual"])

    coarse, fine = residual(1, 0.004), residual(200, 0.0045)
    assert fine < 1e-3 * coarse


def test_tissue_twice_as_stiff_pushes_twice_as_hard_once_it_is_ready(pressed, monkeypatch):
    go, make = threading.Event(), live_tissue.compile_solver
    node, press = pressed()
    force = press()
    assert force < 0
    assert node.health.state == "fem"

    def slowly(*given):
        assert go.wait(60)
        return make(*given)

    monkeypatch.setattr(live_tissue, "compile_solver", slowly)
    materials = [
        name for name in node.get_parameters_by_prefix("materials") if "young_modulus" in name
    ]
    for name in materials:
        value = node.get_parameter(f"materials.{name}").value
        assert attempt(node, f"materials.{name}", 2 * value).successful
    for depth in (0.0041, 0.004):
        assert press(depth) == pytest.approx(force, rel=0.1)
    assert press(0.004) == pytest.approx(force, rel=1e-6)  # the old tissue goes on
    assert node.health.preparing
    go.set()
    for turn in range(1000):
        if press(0.004 + 1e-9 * (turn % 2)) < 1.5 * force:
            break
    assert press(0.004) == pytest.approx(2 * force, rel=1e-5)  # linear in the moduli
    assert node.health.state == "fem"


def test_what_cannot_be_made_is_set_back_and_said(bench, pressed):
    node, press = pressed(solver="msds")
    reports = bench.collect(DiagnosticArray, "diagnostics")
    before = press()
    asked = {"msds.stabilisation": "substeps", "msds.maximum_substeps": 1, "msds.time_step": 5.0}
    old = {name: node.get_parameter(name).value for name in asked}
    parameters = [Parameter(name, value=value) for name, value in asked.items()]
    assert node.set_parameters_atomically(parameters).successful
    bench.spin_until(lambda: node.health.problems["setting"] == 1)
    assert {name: node.get_parameter(name).value for name in asked} == old
    bench.spin_until(
        lambda: any(
            status.level == DiagnosticStatus.WARN
            and KeyValue(key="problem", value="setting") in status.values
            for report in reports
            for status in report.status
        )
    )
    assert press() * before > 0
    assert node.health.state == "msds"


def test_what_is_set_back_may_be_what_two_settings_say_together(bench, pressed):
    node, _ = pressed(solver="fem", compare_with="msds", lockstep=True)
    parameters = [
        Parameter("solver", value="msds"),
        Parameter("compare_with", value="fem"),
        Parameter("msds.stabilisation", value="substeps"),
        Parameter("msds.maximum_substeps", value=1),
        Parameter("msds.time_step", value=5.0),
    ]
    assert node.set_parameters_atomically(parameters).successful
    assert node.health.problems["setting"] == 1
    assert node.get_parameter("solver").value == "fem"
    assert node.get_parameter("compare_with").value == "msds"
    bench.spin_for(3)


@pytest.mark.parametrize(
    ("node", "given", "checked"),
    [
        ("slice_interpolator", {"gain": "6 dB", "depth": "60 mm"}, {"gain": 6.0, "depth": 0.06}),
        ("slice_interpolator", {"time_gain": "[1, 2 dB]"}, {"time_gain": [1.0, 2.0]}),
        ("slice_interpolator", {"focus": "0"}, {"focus": 0.0}),
        ("tissue_deformer", {"fem_cg.iterations": "3"}, {"fem_cg.iterations": 3}),
        (
            "tissue_deformer",
            {"materials.fat.young_modulus": "6 kPa"},
            {"materials.fat.young_modulus": 6000.0},
        ),
        ("camera_driver", {"source": "0", "rate": "30 Hz"}, {"source": "0", "rate": 30.0}),
    ],
)
def test_parameters_of_the_command_line_have_units(scene, node, given, checked):
    made = check_parameters(node, load_scene(scene), given)
    assert made == checked
    assert [type(value) for value in made.values()] == [type(value) for value in checked.values()]


@pytest.mark.parametrize(
    ("node", "given", "fact"),
    [
        ("slice_interpolator", {"gian": "6"}, "gian'.* 'gain'"),
        ("slice_interpolator", {"gain": "6 mm"}, "gain: '6 mm' .*level.* dB"),
        ("slice_interpolator", {"gain": "99"}, "gain: 99 dB .* -60 to 60 dB"),
        ("slice_interpolator", {"depth": "60"}, "depth: 60 m .*'60 mm'"),
        ("slice_interpolator", {"gain": "[1"}, r"gain=\[1: .*YAML"),
        ("slice_interpolator", {"lines": "3"}, "lines: .*reference"),  # not while it runs
        ("tissue_deformer", {"materials.fta.density": "3"}, "'materials.fat.density'"),
        ("tissue_deformer", {"young": "1"}, "young: .{,80}`us-sim reference tissue_deformer`"),
    ],
)
def test_a_wrong_parameter_of_the_command_line_is_one_sentence(scene, node, given, fact):
    with pytest.raises(UsSimError, match=rf"\A--param {node}\..*{fact}.*\Z"):
        check_parameters(node, load_scene(scene), given)
