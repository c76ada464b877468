"""Which parameters of a node stand together under one title, and in which order."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from us_sim.viewer.parameters import Parameter, in_words

Arrange = Callable[[Mapping[str, Parameter]], list["Section"]]
"""Puts the parameters of a node, by name, into sections."""


@dataclass(frozen=True)
class Section:
    """Parameters under one title."""

    key: str  # what it is known by while its parameters change
    title: str  # without one it cannot be folded away
    names: tuple[str, ...]
    labels: Mapping[str, str] = field(default_factory=dict)  # in place of the parameters' own
    is_open: bool = False  # at first
    is_shown: bool = True


def common_first(common: tuple[str, ...]) -> Arrange:
    """These first, then the others, group by group, and last what was given at the start.

    Without any of these, the parameters of no group are first.
    """

    def arrange(parameters: Mapping[str, Parameter]) -> list[Section]:
        live = [name for name in parameters if parameters[name].is_live]
        first = tuple(name for name in common if name in live)
        first = first or tuple(name for name in live if not parameters[name].group)
        rest = [name for name in parameters if name not in first]
        sections = [Section("common", "", first)]
        return sections + groups_of(parameters, rest) + given_at_the_start(parameters, rest)

    return arrange


def groups_of(parameters: Mapping[str, Parameter], names: Iterable[str]) -> list[Section]:
    """A section for each group of these names, of what may change; those of none are "More"."""
    groups: dict[str, list[str]] = {}
    for name in names:
        if parameters[name].is_live:
            groups.setdefault(parameters[name].group, []).append(name)
    return [
        Section(f"group {group}", title_of(group) if group else "More", tuple(members))
        for group, members in sorted(groups.items(), key=lambda each: bool(each[0]))
    ]


def groups_in_use(
    parameters: Mapping[str, Parameter], names: Iterable[str], choosing: Iterable[str]
) -> tuple[list[Section], list[Section]]:
    """The groups of these names: those that belong to a choice, and the others.

    A parameter of ``choosing`` chooses the group that has the name of its value; the groups of its
    other choices are not shown.
    """
    choosing = [name for name in choosing if name in parameters]
    known = {choice for name in choosing for choice in parameters[name].choices}
    in_use = {parameters[name].value for name in choosing}
    belonging, others = [], []
    for section in groups_of(parameters, names):
        group = parameters[section.names[0]].group
        if group in known:
            title = f"Settings of {group}"
            belonging.append(dataclasses.replace(section, title=title, is_shown=group in in_use))
        else:
            others.append(section)
    return belonging, others


def chosen_first(choosing: str) -> Arrange:
    """A choice and the settings of what is chosen, and then all others."""

    def arrange(parameters: Mapping[str, Parameter]) -> list[Section]:
        first = tuple(name for name in (choosing,) if name in parameters)
        rest = [name for name in parameters if name not in first]
        belonging, others = groups_in_use(parameters, rest, first)
        return [
            Section("common", "", first),
            *belonging,
            *others,
            *given_at_the_start(parameters, rest),
        ]

    return arrange


def given_at_the_start(parameters: Mapping[str, Parameter], names: Iterable[str]) -> list[Section]:
    """What cannot be changed any more, if there is any."""
    fixed = tuple(name for name in names if not parameters[name].is_live)
    labels = {name: in_words(name) for name in fixed}
    return [Section("fixed", "Given at the start", fixed, labels)] if fixed else []


def title_of(group: str) -> str:
    """What comes before parameters' names, in words."""
    words = in_words(group)
    return words[:1].upper() + words[1:]
