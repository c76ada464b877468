"""Log messages: their line, their filters, their levels, and the topic /rosout."""

import os
import re
import subprocess
import sys
import time

import pytest
import rclpy
from rcl_interfaces.msg import Log
from rclpy.clock import ROSClock
from rclpy.logging import (
    LoggingSeverity,
    get_logger,
    get_logger_effective_level,
    set_logger_level,
)
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time

LINE = re.compile(r"\[(\w+)\] \[(\d+)\.(\d{9})\] \[([\w.]+)\]: (.*)")


def lines(capfd: pytest.CaptureFixture[str]) -> list[tuple[str, str, str]]:
    """Severity, logger and text of what was written to standard error."""
    captured = capfd.readouterr()
    assert captured.out == ""
    found = [LINE.fullmatch(line) for line in captured.err.splitlines()]
    assert all(found), captured.err
    return [(match[1], match[4], match[5]) for match in found if match]


def test_a_line_has_severity_time_name_and_text(capfd) -> None:
    before = time.time()
    get_logger("probe.camera").info("lens is clean")
    err = capfd.readouterr().err
    match = LINE.fullmatch(err.rstrip("\n"))
    assert match
    assert (match[1], match[4], match[5]) == ("INFO", "probe.camera", "lens is clean")
    assert before - 0.001 <= float(f"{match[2]}.{match[3]}") <= time.time() + 0.001


def test_severities_and_levels(capfd) -> None:
    logger = get_logger("levels")
    logger.debug("unseen")
    logger.info("a")
    logger.warning("b")
    logger.warn("c")
    logger.error("d")
    logger.fatal("e")
    logger.log("f", LoggingSeverity.ERROR)
    assert lines(capfd) == [
        ("INFO", "levels", "a"),
        ("WARN", "levels", "b"),
        ("WARN", "levels", "c"),
        ("ERROR", "levels", "d"),
        ("FATAL", "levels", "e"),
        ("ERROR", "levels", "f"),
    ]
    logger.set_level(LoggingSeverity.ERROR)
    assert logger.warn("unseen") is False
    assert logger.error("seen") is True
    assert not logger.is_enabled_for(LoggingSeverity.WARN)
    assert logger.get_child("child").get_effective_level() == LoggingSeverity.ERROR
    assert get_logger_effective_level("levels.child") == LoggingSeverity.ERROR
    set_logger_level("levels.child", LoggingSeverity.DEBUG)
    assert get_logger("levels.child.deep").is_enabled_for(LoggingSeverity.DEBUG)
    with pytest.raises(ValueError, match="22 is not a valid"):
        set_logger_level("levels", 22)
    assert len(lines(capfd)) == 1


def test_names_of_loggers(capfd) -> None:
    assert get_logger("a").get_child("b").name == "a.b"
    with pytest.raises(ValueError, match="must not be empty"):
        get_logger("")
    with pytest.raises(ValueError, match="must not be empty"):
        get_logger("a").get_child("")
    get_logger("a").info("text", name="b")
    assert lines(capfd) == [("INFO", "b", "text")]


def test_once_skip_first_and_throttle_count_for_each_place(capfd) -> None:
    logger = get_logger("filters")
    clock = ROSClock()
    clock._set_ros_time_is_active(True)
    for second in range(6):
        clock.set_ros_time_override(Time(seconds=second, clock_type=clock.clock_type))
        logger.info(f"once {second}", once=True)
        logger.info(f"later {second}", skip_first=True)
        logger.info(
            f"sometimes {second}", throttle_duration_sec=2.0, throttle_time_source_type=clock
        )
    texts = [text for _, _, text in lines(capfd)]
    assert [text for text in texts if text.startswith("once")] == ["once 0"]
    assert [text for text in texts if text.startswith("later")] == [
        f"later {second}" for second in range(1, 6)
    ]
    assert [text for text in texts if text.startswith("sometimes")] == [
        "sometimes 2",
        "sometimes 4",
    ]


def test_throttling_by_the_wall_lets_the_first_one_through(capfd) -> None:
    logger = get_logger("filters")
    for number in range(3):
        logger.warn(f"dropped {number}", throttle_duration_sec=100.0)
    assert lines(capfd) == [("WARN", "filters", "dropped 0")]


def test_filters_are_checked() -> None:
    logger = get_logger("filters")
    with pytest.raises(TypeError, match='parameter "twice" is not one of'):
        logger.info("text", twice=True)
    with pytest.raises(TypeError, match='required parameter "throttle_duration_sec"'):
        logger.info("text", throttle_time_source_type=ROSClock())
    for seconds in (1.0, 1.0):
        logger.debug("unseen", throttle_duration_sec=seconds)

    def say(severity: LoggingSeverity, **options: object) -> None:
        logger.log("text", severity, **options)

    say(LoggingSeverity.WARN, once=True)
    with pytest.raises(ValueError, match="severity cannot be changed"):
        say(LoggingSeverity.ERROR, once=True)
    with pytest.raises(ValueError, match="filters cannot be changed"):
        say(LoggingSeverity.WARN, skip_first=True)
    with pytest.raises(ValueError, match="name cannot be changed"):
        say(LoggingSeverity.WARN, once=True, name="other")


def test_nodes_log_under_their_full_name_and_on_rosout(bench) -> None:
    node = bench.node("probe", namespace="left/arm")
    heard: list[Log] = []
    latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.get_logger().warning("before anybody listens")
    bench.node("listener", enable_rosout=False).create_subscription(
        Log, "/rosout", heard.append, latched
    )
    child = node.get_logger().get_child("camera")
    child.error("lens is dirty")
    bench.node("quiet", enable_rosout=False).get_logger().error("not published")
    assert bench.spin_until(lambda: len(heard) == 2)
    assert [(log.name, log.level, log.msg) for log in heard] == [
        ("left.arm.probe", 30, "before anybody listens"),
        ("left.arm.probe.camera", 40, "lens is dirty"),
    ]
    assert heard[0].function == "test_nodes_log_under_their_full_name_and_on_rosout"
    assert heard[0].file.endswith("test_rclpy_logging.py")
    assert heard[0].line > 0
    assert heard[0].stamp.sec > 1_000_000_000


SPEAK = """
import us_sim.nodes
import rclpy, sys
rclpy.init(args=["x", "--ros-args", *sys.argv[1:]])
node = rclpy.create_node("probe")
node.get_logger().debug("details")
node.get_logger().warning("dropped")
rclpy.shutdown()
"""


def spoken(*args: str, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", SPEAK, *args],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    return done.stderr + done.stdout


def test_arguments_set_levels_and_outputs() -> None:
    detailed = spoken("--log-level", "probe:=debug")
    assert [line.rpartition(": ")[2] for line in detailed.splitlines()] == ["details", "dropped"]
    coloured = spoken(RCUTILS_COLORIZED_OUTPUT="1")
    assert coloured.startswith("\033[33m[WARN] ")
    assert coloured.endswith("[probe]: dropped\033[0m\n")
    assert spoken("--disable-stdout-logs") == ""


def test_a_logger_of_no_node_is_not_published(bench) -> None:
    heard: list[Log] = []
    node = bench.node("probe")
    node.create_subscription(Log, "/rosout", heard.append, 10)
    rclpy.logging.get_logger("elsewhere").error("text")
    node.get_logger().info("own")
    assert bench.spin_until(lambda: any(log.msg == "own" for log in heard))
    assert not [log for log in heard if log.name == "elsewhere"]
