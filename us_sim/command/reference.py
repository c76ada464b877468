"""The command `us-sim reference`: topics, node parameters and scene settings, as tables.

`docs/reference.md` is its output in a plain installation. Solvers and trackers of other installed
packages are in the output, too.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path

from us_sim.errors import UsSimError
from us_sim.settings.registry import PROBES
from us_sim.settings.setting import Settings, kinds_of, rules_of
from us_sim.settings.spelling import describe_unknown, find_closest
from us_sim.settings.tables import (
    Section,
    describe_default,
    describe_values,
    extract_summary,
    format_table,
    make_anchor,
    make_sections,
    tabulate_settings,
)

INTRODUCTION = """\
# Reference

Every topic, every node parameter and every key of a scene, with its range and default. The command
`us-sim reference --out docs/reference.md` writes this page from the code; `us-sim reference tissue`
prints one part: `topics`, a node, or a key of a scene. Read a description after its name: `depth`
… of the image.

- [Topics](#topics)
- [Node parameters](#node-parameters)
- [Scene settings](#scene-settings)
"""

TOPICS_TEXT = """\
Names are relative to the simulator's namespace. Publishers are reliable and keep the last 100
messages; latched topics keep the last one for later subscribers (transient local). Nodes hear
drivers best effort. The parameters `qos_overrides.…` of each node change history, depth and
reliability. `session_recorder` subscribes to all topics except excluded ones; `session_player`
publishes all of a recording; `session_monitor` is `us-sim` itself."""

PARAMETERS_TEXT = """\
`ros2 param set /tissue_deformer solver msds` sets a parameter of a running node where "while
running" says yes; set others at the start: `--ros-args -p name:=value`, or
`us-sim run SCENE --param NODE.NAME=VALUE`. Values are in SI units (m, s, Pa, rad); `--param` also
takes units (`40 mm`). For *none*, set 0 (a number) or '' (a text). ROS 2's own commands need a
decimal point in a number that may be a fraction (`6.0`)."""

SCENE_TEXT = """\
A scene is a YAML file. It must have `name`, `volume` and `probe`; what it does not name costs
nothing. Numbers are in SI units (m, s, Pa, rad) or carry a unit (`40 mm`, `12 kPa`, `30 deg`).
Relative files are beside the scene's own file. `based_on: OTHER` takes what this scene does not
give from another one, a file or a name. `tissue.mesh.nodes` is the key `nodes`
in `mesh` in `tissue`; `NAME` stands for a name of your choice."""

POSE = "A pose"

_OF_THE_SCENE = {
    "slice_interpolator": {
        "`acoustics.KEY`, but the last,": "imaging.acoustics",
        "`acoustics.tissues.LABEL.KEY`": "imaging.acoustics.tissues.NAME",
        "`strain.KEY`": "strain",
        "`m_mode.KEY`": "m_mode",
        "`colour.KEY`": "colour",
        "`spectrum.KEY`": "spectrum",
        "`flow.STRUCTURE.KEY`": "structures.NAME.flow",
    },
    "probe_tracker": {"`FILTER.KEY`": "tracker.filter"},
    "skin_deformer": {"`membrane.KEY`, up to `steps`,": "skin"},
    "tissue_deformer": {
        "`SOLVER.KEY`": "tissue.settings",
        "`materials.LABEL.KEY`": "tissue.materials.NAME",
    },
}
"""By node: live parameters, and the section of the scene whose keys they have."""


def reference_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `us-sim reference`."""
    parser.add_argument(
        "part", nargs="?", help="topics, a node, or a key of a scene such as tissue; default: all"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="write to this Markdown file")
    parser.set_defaults(command=_reference)


def _reference(args: argparse.Namespace) -> int:
    text = write_reference_page() if args.part is None else _write_part(args.part)
    if args.out is None:
        print(text, end="")
    else:
        args.out.write_text(text, encoding="utf-8")
    return 0


def write_reference_page() -> str:
    """Write the whole page."""
    return f"{INTRODUCTION}\n{_write_sections(make_reference_sections())}"


def make_reference_sections() -> Iterator[tuple[int, Section]]:
    """Make all sections in order, each with the level of its heading."""
    from us_sim.geometry.pose import Placement
    from us_sim.scene.scene import Scene

    yield 2, Section("topics", "Topics", f"{TOPICS_TEXT}\n\n{_tabulate_topics()}")
    yield 2, Section("parameters", "Node parameters", PARAMETERS_TEXT)
    yield from ((3, section) for section in _make_node_sections())
    yield 2, Section("scene", "Scene settings", SCENE_TEXT)
    yield from ((3, section) for section in make_sections(Scene, "", {Placement: POSE}))
    pose = f"{extract_summary(Placement.__doc__)}\n\n{tabulate_settings(Placement)}"
    yield 3, Section("pose", POSE, pose)


def _write_part(name: str) -> str:
    """Write the sections with a name.

    Raises:
        UsSimError: there is no such section.
    """
    sections = list(make_reference_sections())
    found = [each for each in sections if f"{each[1].path}.".startswith(f"{name}.")]
    # Or those within another section, such as a solver or a kind of probe.
    found = found or [each for each in sections if f".{name}." in f"{each[1].path}."]
    if not found:
        known = [section.path for _, section in sections if section.path]
        if find_closest(name, known) is None:
            known = list(dict.fromkeys(path.split(".")[0] for path in known))
        raise UsSimError(f"reference: {describe_unknown(name, known)}")
    return _write_sections(found)


def _write_sections(sections: Iterable[tuple[int, Section]]) -> str:
    return "\n".join(f"{'#' * level} {each.title}\n\n{each.text}\n" for level, each in sections)


def _tabulate_topics() -> str:
    from us_sim.nodes.settings import NODES
    from us_sim.nodes.topics import TOPICS

    rows = []
    for topic in TOPICS:
        sources = _list_names(topic.publishers)
        if topic.is_from_drivers:
            sources = f"a driver, {sources}" if sources else "a driver"
        elif len(topic.publishers) > len(NODES) / 2:
            silent = [node for node in NODES if node not in topic.publishers]
            sources = f"every node but {_list_names(silent)}"
        kind = f"{topic.type_name}{' (latched)' if topic.latched else ''}"
        subscribers = _list_names(topic.subscribers)
        rows.append((f"`{topic.name}`", kind, sources, subscribers, topic.description))
    return format_table(("topic", "type", "from", "to", "what it carries"), rows)


def _list_names(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _make_node_sections() -> Iterator[Section]:
    """Make the sections of the nodes' parameters."""
    from us_sim.nodes.settings import NODES, SceneNodeSettings
    from us_sim.slicing.settings import Imaging

    common = "Every node that works on a scene"
    yield Section("scene_nodes", common, _tabulate_parameters(SceneNodeSettings))
    for node, settings in NODES.items():
        text = []
        if SceneNodeSettings in settings:
            text.append(f"Also the [common parameters](#{make_anchor(common)}).")
        for each in settings:
            if each is Imaging:
                live = _list_live_of_probes()
                text.append(f"The keys of [imaging](#imaging), and {live} of the [probe](#probe).")
            elif each is not SceneNodeSettings:
                about = extract_summary(each.__doc__)
                is_more = not about.lower().endswith(f"of `{node}`.")  # than whose they are
                text += [about] * is_more + [_tabulate_parameters(each)]
        if node in _OF_THE_SCENE:
            keys = _OF_THE_SCENE[node].items()
            links = ", ".join(f"{key} of [{title}](#{make_anchor(title)})" for key, title in keys)
            text.append(f"While running, for what the scene names, with its defaults: {links}.")
        yield Section(node, node, "\n\n".join(text))


def _list_live_of_probes() -> str:
    """List the settings that every kind of probe lets change while images are made."""
    from us_sim.nodes.settings import is_live

    kinds = [PROBES.load_settings(name) for name in PROBES]
    live = [{name for name in rules_of(kind) if is_live(kind, name)} for kind in kinds]
    return _list_names(sorted(set.intersection(*live)))


def _tabulate_parameters(settings: type[Settings]) -> str:
    """Make a table of settings as parameters of a node."""
    from us_sim.nodes.settings import is_live

    kinds = kinds_of(settings)
    rows = [
        (
            f"`{name}`",
            describe_values(kinds[name], rule),
            describe_default(settings, name),
            "yes" if is_live(settings, name) else "",
            rule.description,
        )
        for name, rule in rules_of(settings).items()
    ]
    return format_table(("parameter", "value", "default", "while running", "what it is"), rows)
