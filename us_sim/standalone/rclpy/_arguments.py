"""Command-line arguments between `--ros-args` and `--`, parsed as rcl does.

>>> arguments = parse_arguments(["prog", "--ros-args", "-p", "rate:=60.0", "-r", "a:=b", "--", "x"])
>>> arguments.overrides_for("/probe"), arguments.others
({'rate': 60.0}, ('prog', 'x'))
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from ._parameter_files import NodeParameter, read_parameter_file
from ._parameter_values import ParameterSyntaxError, parse_value
from ._rclpy_pybind11 import RCLInvalidROSArgsError, UnknownROSArgsError
from ._remapping import RemapRule, RemapSyntaxError, parse_remap_rule
from .impl.logging_severity import LoggingSeverity

_PARAMETER = re.compile(
    r"(?:(?P<node>[A-Za-z_][A-Za-z0-9_]*):(?!=))?(?P<name>[A-Za-z0-9_./~]+?):=(?P<value>.*)", re.S
)
_SWITCH = re.compile(r"--(?P<turn>enable|disable)-(?P<output>rosout|stdout|external-lib)-logs")
_SHORT = {"-p": "--param", "-r": "--remap", "-e": "--enclave"}


@dataclass(frozen=True)
class Arguments:
    """What was asked for on a command line."""

    remap_rules: tuple[RemapRule, ...] = ()
    parameters: tuple[NodeParameter, ...] = ()  # later ones override earlier ones
    log_level: LoggingSeverity | None = None
    logger_levels: tuple[tuple[str, LoggingSeverity], ...] = ()
    enclave: str = "/"
    disabled_outputs: frozenset[str] = frozenset()  # of rosout, stdout, external-lib
    others: tuple[str, ...] = ()  # what is not for ROS, in order

    def overrides_for(self, node: str) -> dict[str, Any]:
        """Parameter values for a node given by its absolute name; wildcards match it."""
        return {
            name: value
            for pattern, name, value in self.parameters
            if _matches(pattern if pattern.startswith("/") else f"/{pattern}", node)
        }


def _matches(pattern: str, node: str) -> bool:
    """Whether /**, /*, /ns/* and the like cover an absolute node name."""
    regex = re.escape(pattern).replace(r"/\*\*", r"(/\w+)*").replace(r"/\*", r"(/\w+)")
    return re.fullmatch(regex, node) is not None


def parse_arguments(args: Sequence[str]) -> Arguments:
    """Parse a whole command line, the program's name included.

    Raises:
        RCLInvalidROSArgsError: a value is malformed or missing.
        UnknownROSArgsError: something between --ros-args and -- is no argument of ROS.
    """
    rules: list[RemapRule] = []
    parameters: list[NodeParameter] = []
    levels: list[tuple[str | None, LoggingSeverity]] = []
    enclaves = ["/"]
    disabled: set[str] = set()
    others: list[str] = []
    unknown: list[str] = []
    takers: dict[str, tuple[str, Callable[[str], Any]]] = {
        "--param": ("parameter override rule", lambda text: parameters.append(_parameter(text))),
        "--remap": ("remap rule", lambda text: rules.append(parse_remap_rule(text))),
        "--params-file": ("params file", lambda text: parameters.extend(read_parameter_file(text))),
        "--log-level": ("log level", lambda text: levels.append(_level(text))),
        "--enclave": ("enclave name", enclaves.append),
        "--log-config-file": ("log configuration file", lambda _: None),
        "--log-file-name": ("log file name prefix", lambda _: None),
    }
    for_ros = False
    remaining = iter(args)
    for argument in remaining:
        if argument == "--ros-args":
            for_ros = True
        elif not for_ros:
            others.append(argument)
        elif argument == "--":
            for_ros = False
        elif (flag := _SHORT.get(argument, argument)) in takers:
            what, take = takers[flag]
            value = next(remaining, None)
            if value is None:
                raise RCLInvalidROSArgsError(
                    f"Failed to parse ROS arguments: Couldn't parse trailing {argument} flag. "
                    f"No {what} found."
                )
            try:
                take(value)
            except (ParameterSyntaxError, RemapSyntaxError, ValueError) as error:
                raise RCLInvalidROSArgsError(
                    f"Failed to parse ROS arguments: Couldn't parse {what}: "
                    f"'{argument} {value}'. Error: {error}"
                ) from None
        elif switch := _SWITCH.fullmatch(argument):
            (disabled.add if switch["turn"] == "disable" else disabled.discard)(switch["output"])
        else:
            unknown.append(argument)
    if unknown:
        raise UnknownROSArgsError(repr(unknown))
    return Arguments(
        remap_rules=tuple(rules),
        parameters=tuple(parameters),
        log_level=next((level for name, level in reversed(levels) if name is None), None),
        logger_levels=tuple((name, level) for name, level in levels if name is not None),
        enclave=enclaves[-1],
        disabled_outputs=frozenset(disabled),
        others=tuple(others),
    )


def _parameter(text: str) -> NodeParameter:
    found = _PARAMETER.fullmatch(text)
    if found is None:
        raise ParameterSyntaxError("Expected [node:]name:=value")
    return found["node"] or "/**", found["name"], parse_value(found["value"])


def _level(text: str) -> tuple[str | None, LoggingSeverity]:
    name, separator, level = text.rpartition(":=")
    if separator and not name:
        raise ValueError("Argument has an invalid logger item that name is empty")
    if level.upper() not in LoggingSeverity.__members__:
        raise ValueError("Argument does not use a valid severity level")
    return name or None, LoggingSeverity[level.upper()]
