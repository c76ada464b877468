"""Every signature, member and preset against what was introspected from the real rclpy 7.1.3."""

import importlib
import inspect
import json
import re
from enum import Enum
from itertools import accumulate
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy import qos

pytestmark = pytest.mark.skipif(
    rclpy.__name__ == "rclpy", reason="the real rclpy is here, so there is nothing to compare"
)

PAGE = Path(__file__).parents[2] / "docs" / "standalone.md"

# Parts of rclpy's API that the subset leaves out on purpose; `docs/standalone.md` names all of it.
NAMES = {
    "rclpy.event_handler.PublisherEventCallbacks",
    "rclpy.event_handler.SubscriptionEventCallbacks",
    "rclpy.executors.ShutdownException",
    "rclpy.executors.TimeoutException",
    "rclpy.timer.Rate",
    "rclpy.wait_for_message.wait_for_message",
}
"""Classes and functions."""

MEMBERS = {
    "Context": {"handle"},
    "Client": {"configure_introspection", "handle"},
    "Clock": {"create_jump_callback", "handle", "sleep_for", "sleep_until"},
    "Duration": {"get_c_duration"},
    "Executor": {"can_execute", "create_task", "wait_for_ready_callbacks"},
    "GuardCondition": {"handle"},
    "AsyncParameterClient": {
        "delete_parameters",
        "load_parameter_file",
        "load_parameter_file_atomically",
        "on_parameter_event",
    },
    "Node": {
        "add_waitable",
        "count_clients",
        "count_services",
        "create_rate",
        "destroy_rate",
        "get_client_names_and_types_by_node",
        "get_node_names_and_namespaces_with_enclaves",
        "get_publisher_names_and_types_by_node",
        "get_service_names_and_types",
        "get_service_names_and_types_by_node",
        "get_subscriber_names_and_types_by_node",
        "handle",
        "remove_waitable",
        "set_descriptor",
        "wait_for_node",
        "waitables",
    },
    "Publisher": {"assert_liveliness", "handle", "wait_for_all_acked"},
    "QoSPresetProfiles": {"BEST_AVAILABLE"},
    "QoSProfile": {"get_c_qos_profile"},
    "ReliabilityPolicy": {"BEST_AVAILABLE"},
    "DurabilityPolicy": {"BEST_AVAILABLE"},
    "LivelinessPolicy": {"BEST_AVAILABLE"},
    "Service": {"configure_introspection", "handle"},
    "Subscription": {"handle"},
    "Timer": {"handle"},
}
"""Members by the class that has them; classes derived from it lack them too."""

PARAMETERS = {
    "create_node": {"enable_logger_service"},
    "Node.__init__": {"enable_logger_service"},
    "Node.create_publisher": {"event_callbacks", "publisher_class"},
    "Node.create_subscription": {"event_callbacks"},
}
"""Parameters of functions that are there."""

PROFILES = {"qos_profile_best_available"}
"""Presets of `rclpy.qos`."""

MADE_BY_NODES = {"Client", "Publisher", "Service", "Subscription"}
"""Classes whose constructors take something of the middleware, which is another one here."""


@pytest.fixture(scope="session")
def api(shared_data: Path) -> dict[str, Any]:
    return json.loads((shared_data / "ros2-jazzy" / "rclpy_api.json").read_text())


def ours(name: str) -> Any:
    """Our attribute of a dotted name, None when we lack it."""
    module, _, attribute = name.rpartition(".")
    try:
        return getattr(importlib.import_module(module), attribute, None)
    except ModuleNotFoundError:
        return None


def split(text: str) -> list[str]:
    """The comma-separated parts of a parameter list, brackets and quotes respected."""
    parts, depth, start, quote = [], 0, 0, ""
    for index, character in enumerate(text):
        if quote:
            quote = "" if character == quote else quote
        elif character in "'\"":
            quote = character
        elif character in "([{<":
            depth += 1
        elif character in ")]}>":
            depth -= 1
        elif character == "," and not depth:
            parts.append(text[start:index].strip())
            start = index + 1
    return [part for part in [*parts, text[start:].strip()] if part]


def parameters(signature: str) -> list[tuple[str, str, str | None]]:
    """Kind, name and default (as text) of the parameters in a signature's text."""
    depths = accumulate({"(": 1, ")": -1}.get(character, 0) for character in signature)
    end = next(index for index, depth in enumerate(depths) if not depth)
    kind, found = "POSITIONAL_OR_KEYWORD", []
    for part in split(signature[1:end]):
        if part == "/":
            found = [("POSITIONAL_ONLY", name, default) for _, name, default in found]
        elif part == "*":
            kind = "KEYWORD_ONLY"
        elif part.startswith("**"):
            found.append(("VAR_KEYWORD", part[2:].partition(":")[0], None))
        elif part.startswith("*"):
            found.append(("VAR_POSITIONAL", part[1:].partition(":")[0], None))
            kind = "KEYWORD_ONLY"
        else:
            name = re.match(r"\w+", part).group()
            default = re.search(r"=\s*(.*)$", re.sub(r"^[^=]*\[.*\](?=\s*=)", "", part))
            found.append((kind, name, default.group(1) if default else None))
    return found


def expected_parameters(name: str, signature: str) -> list[tuple[str, str, str | None]]:
    """The parameters of rclpy's function but for those that are left out on purpose."""
    function = ".".join(name.split(".")[2 if name.count(".") > 1 else 1 :])
    left_out = PARAMETERS.get(function, set())
    found = parameters(signature)
    assert left_out <= {parameter for _, parameter, _ in found}, f"rclpy's {name} has no {left_out}"
    return [parameter for parameter in found if parameter[1] not in left_out]


def shown(default: Any) -> str | None:
    if default is inspect.Parameter.empty:
        return None
    if isinstance(default, qos.QoSProfile):
        return "<rclpy.qos.QoSProfile object>"
    if inspect.isclass(default):
        return (
            f"<class '{default.__module__.replace('us_sim.standalone.', '')}.{default.__name__}'>"
        )
    return repr(default)


def parameters_of(function: Any) -> list[tuple[str, str, str | None]]:
    return [
        (parameter.kind.name, parameter.name, shown(parameter.default))
        for parameter in inspect.signature(function).parameters.values()
    ]


def is_inherited(cls: type, member: str) -> bool:
    """Whether a member comes from Python itself."""
    return not any(
        member in vars(base)
        for base in cls.__mro__
        if base.__module__.partition(".")[0] in PACKAGES
    )


PACKAGES = ("rclpy", "us_sim")


def compare_class(name: str, cls: type, members: dict[str, str]) -> list[str]:
    wrong = []
    for member in ["__init__", *(m for m in dir(cls) if not m.startswith("_"))]:
        if is_inherited(cls, member):
            continue
        if member == "__init__" and cls.__name__ in MADE_BY_NODES:
            continue
        if member not in members:
            wrong.append(f"{name}.{member} is not in rclpy")
            continue
        expected = members[member]
        value = inspect.getattr_static(cls, member)
        if expected == "property":
            same = isinstance(value, property)
        elif expected.startswith("value "):
            actual = getattr(cls, member)
            text = str(int(actual)) if isinstance(actual, int) else repr(actual)
            same = re.sub(r"us_sim\.standalone\.| at 0x\w+", "", text) in expected
        elif inspect.isclass(value):
            same = True  # a nested class has a check of its own where it matters
        elif expected.startswith("classmethod "):
            text = expected.removeprefix("classmethod ")
            same = isinstance(value, classmethod) and parameters_of(
                getattr(cls, member)
            ) == parameters(text)
        else:
            wanted = expected_parameters(f"{name}.{member}", expected)
            same = parameters_of(getattr(cls, member)) == wanted
        if not same:
            wrong.append(f"{name}.{member} differs from rclpy's {expected}")
    return wrong


def test_every_name_of_the_api_has_rclpys_parameters_kinds_and_defaults(
    api: dict[str, Any],
) -> None:
    wrong, missing = [], set()
    for name, expected in api.items():
        if name == "qos profiles":
            continue
        found = ours(name)
        if found is None:
            missing.add(name)
        elif isinstance(expected, str):
            if parameters_of(found) != expected_parameters(name, expected):
                wrong.append(f"{name} differs from rclpy's {expected}")
        else:
            wrong += compare_class(name, found, expected["members"])
    assert missing == NAMES
    assert not wrong, "\n".join(wrong)


def test_what_classes_lack_is_listed(api: dict[str, Any]) -> None:
    lacking: dict[str, set[str]] = {}
    for name, expected in api.items():
        if name == "qos profiles" or isinstance(expected, str) or name in NAMES:
            continue
        found = set(dir(ours(name))) | {"Parameter", "__init__", "name", "value"}
        members = {member for member in expected["members"] if not hasattr(int, member)}
        lacking[name.rpartition(".")[2]] = members - found - {"is_integer"}
    for name, members in lacking.items():
        inherited = [lacking[base] for base in ("Clock", "Executor") if name.endswith(base)]
        assert members == MEMBERS.get(name, set().union(*inherited)), name
    assert MEMBERS.keys() <= lacking.keys()


def test_the_page_names_everything_that_is_left_out() -> None:
    page = PAGE.read_text(encoding="utf-8").partition("## What is not in it")[2]
    listed = set(re.findall(r"`(?:\w+\.)*(\w+)`", page.partition("\n## ")[0]))
    left_out = {name.rpartition(".")[2] for name in NAMES | PROFILES}
    left_out |= {member for members in MEMBERS.values() for member in members}
    left_out |= {name for names in PARAMETERS.values() for name in names}
    assert left_out - listed == set()


def test_the_presets_of_quality_of_service_are_rclpys(api: dict[str, Any]) -> None:
    for name, expected in api["qos profiles"].items():
        if name in PROFILES:
            assert not hasattr(qos, name)
            continue
        profile = qos.QoSProfile(depth=10) if "(" in name else getattr(qos, name)
        for policy, value in expected.items():
            actual = getattr(profile, policy)
            if isinstance(actual, Enum):
                actual = actual.name
            assert getattr(actual, "nanoseconds", actual) == value, f"{name}.{policy}"
