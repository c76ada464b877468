"""Command lines: which arguments are for ROS, what they set, and which are refused."""

from pathlib import Path

import pytest
import rclpy
from rclpy._rclpy_pybind11 import RCLInvalidROSArgsError, UnknownROSArgsError
from rclpy.context import Context
from rclpy.logging import LoggingSeverity, get_logger, get_logger_effective_level
from rclpy.parameter import Parameter
from rclpy.utilities import remove_ros_args

PARAMETERS = """
/**:
  ros__parameters:
    rate: 60
    tissue: {solver: msds, young_modulus: 1.0e4}
/*:
  ros__parameters: {rate: 50}
probe:
  ros__parameters:
    rate: 30
    names: [vein, artery]
left:
  skin:
    ros__parameters: {rate: 20}
/left/*:
  ros__parameters: {side: left}
/**/needle:
  ros__parameters: {sharp: yes}
"""


def overrides(bench, node: str, namespace: str = "", **options: object) -> dict[str, object]:
    node = bench.node(
        node,
        namespace=namespace,
        automatically_declare_parameters_from_overrides=True,
        **options,
    )
    return {
        name: parameter.value
        for name, parameter in node.get_parameters_by_prefix("").items()
        if name not in ("use_sim_time", "start_type_description_service")
    }


def test_everything_between_ros_args_and_two_dashes_is_for_ros() -> None:
    args = ["run", "-v", "--ros-args", "-r", "a:=b", "-p", "x:=1", "--", "scene.yaml"]
    args += ["--ros-args", "--log-level", "info"]
    assert remove_ros_args(args) == ["run", "-v", "scene.yaml"]
    assert remove_ros_args([]) == []


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1),
        ("0x10", 16),
        ("-3", -3),
        ("1.5", 1.5),
        ("1e3", 1000.0),
        (".5", 0.5),
        ("-.inf", float("-inf")),
        ("true", True),
        ("off", False),
        ("yes", True),
        ("msds", "msds"),
        ("'1'", "1"),
        ('"true"', "true"),
        ("!!str 12", "12"),
        ("[1, 2]", [1, 2]),
        ("[1.0, 2.5]", [1.0, 2.5]),
        ("[a, 'b']", ["a", "b"]),
        ("[true, off]", [True, False]),
        ("a:=b", "a:=b"),
        ("/us/image", "/us/image"),
        ("10 mm", "10 mm"),
    ],
)
def test_parameter_values_have_the_types_that_rcl_gives_them(
    bench_with, text: str, value: object
) -> None:
    found = overrides(bench_with(["--ros-args", "-p", f"value:={text}"]), "probe")["value"]
    assert found == value
    assert type(found) is type(value)


def test_parameters_can_be_for_one_node_and_the_last_one_wins(bench_with) -> None:
    bench = bench_with(
        "--ros-args -p rate:=1 -p probe:rate:=2 --param a.b:=3 -p skin:rate:=4 -p skin:rate:=5"
    )
    assert overrides(bench, "probe") == {"rate": 2, "a.b": 3}
    assert overrides(bench, "skin") == {"rate": 5, "a.b": 3}
    assert overrides(bench, "probe", "left") == {"rate": 1, "a.b": 3}  # the name is absolute


def test_parameter_files_have_wildcards_namespaces_and_groups(bench_with, tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(PARAMETERS)
    bench = bench_with(["--ros-args", "--params-file", str(file), "-p", "tissue.solver:=fem_cg"])
    everywhere = {"tissue.solver": "fem_cg", "tissue.young_modulus": 10000.0}
    assert overrides(bench, "probe") == {"rate": 30, "names": ["vein", "artery"], **everywhere}
    assert overrides(bench, "other") == {"rate": 50, **everywhere}
    assert overrides(bench, "skin", "left") == {"rate": 20, "side": "left", **everywhere}
    assert overrides(bench, "needle", "a/b") == {"rate": 60, "sharp": True, **everywhere}


def test_overrides_given_in_code_come_last_and_a_nodes_own_arguments_before(bench_with) -> None:
    bench = bench_with("--ros-args -p a:=1 -p b:=1 -p c:=1")
    found = overrides(
        bench,
        "probe",
        cli_args=["--ros-args", "-p", "b:=2", "-p", "c:=2"],
        parameter_overrides=[Parameter("c", value=3)],
    )
    assert found == {"a": 1, "b": 2, "c": 3}
    assert overrides(bench, "alone", use_global_arguments=False) == {}


@pytest.mark.parametrize(
    ("args", "sentence"),
    [
        (["-r", "us image:=b"], "Couldn't parse remap rule: '-r us image:=b'"),
        (["-r", "image"], "Couldn't parse remap rule"),
        (["-r", "__ns:=left"], "Couldn't parse remap rule"),
        (["-r"], "Couldn't parse trailing -r flag. No remap rule found"),
        (["-p", "rate"], "Couldn't parse parameter override rule: '-p rate'"),
        (["-p", "rate:=[1, a]"], "Sequence should be of same type"),
        (["--params-file", "/nowhere.yaml"], "Couldn't parse params file"),
        (["--log-level", "loud"], "Couldn't parse log level"),
        (["--params-file"], "Couldn't parse trailing --params-file flag"),
    ],
)
def test_malformed_arguments_are_told(args: list[str], sentence: str) -> None:
    with pytest.raises(RuntimeError) as caught:
        rclpy.init(context=Context(), args=["--ros-args", *args])
    assert sentence in str(caught.value)
    with pytest.raises(RCLInvalidROSArgsError) as caught:
        remove_ros_args(["--ros-args", *args])
    assert sentence in str(caught.value)


def test_unknown_arguments_are_told() -> None:
    with pytest.raises(UnknownROSArgsError, match=r"\['--speed', '5'\]"):
        rclpy.init(context=Context(), args=["--ros-args", "--speed", "5"])


@pytest.mark.parametrize(
    "text",
    [
        "probe: {ros__parameters: {rate: [1, 2.0]}}",
        "probe: {ros__parameters: {rate: }}",
        "probe: {ros__parameters: 3}",
        "ros__parameters: {rate: 1}",
        "probe: {rate: 1}",
        "pro be: {ros__parameters: {rate: 1}}",
        "probe: {ros__parameters: {rate: 1}",
        "[1, 2]",
    ],
)
def test_files_that_are_no_parameter_files_are_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(text)
    for path in (str(file), "/dev/zero"):
        with pytest.raises(RuntimeError, match="Couldn't parse params file"):
            rclpy.init(context=Context(), args=["--ros-args", "--params-file", path])


def test_log_levels_come_from_arguments(bench_with) -> None:
    try:
        bench_with("--ros-args --log-level probe.camera:=debug --log-level error")
        assert get_logger("anything").get_effective_level() == LoggingSeverity.ERROR
        assert get_logger_effective_level("probe.camera.left") == LoggingSeverity.DEBUG
    finally:
        rclpy.logging.set_logger_level("", LoggingSeverity.INFO)
        rclpy.logging.set_logger_level("probe.camera", LoggingSeverity.UNSET)


def test_domains_come_from_the_call_or_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "61")
    for given, domain in ((None, 61), (62, 62)):
        context = Context()
        rclpy.init(context=context, args=[], domain_id=given)
        assert context.get_domain_id() == domain
        context.shutdown()
    with pytest.raises(RuntimeError, match="lower than zero"):
        Context().init([], domain_id=-1)
    with pytest.raises(RuntimeError, match="must be initialized"):
        Context().get_domain_id()
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    with pytest.raises(RuntimeError, match="failed to initialize rcl"):
        Context().init([])
    monkeypatch.setenv("ROS_DOMAIN_ID", "61")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "everywhere")
    if rclpy.__name__ != "rclpy":
        with pytest.raises(RuntimeError, match="set it to one of SUBNET, LOCALHOST"):
            Context().init([])
