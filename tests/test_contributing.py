"""The two walks of CONTRIBUTING.md work as they are written there, from a package of one's own."""

import re
import sys
import textwrap
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
from bench import Bench, pose_at
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.parameter import Parameter

from us_sim.command.main import main
from us_sim.evaluation.independent_forces import bound_imbalance
from us_sim.evaluation.tissue_methods import EvaluatedMethod
from us_sim.geometry.pose import Pose
from us_sim.nodes.tissue_deformer import TissueDeformer
from us_sim.settings.registry import SOLVERS, TRACKERS
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.solver import create_solver

TEXT = (Path(__file__).resolve().parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")


def blocks(language):
    """The code blocks of a language, in order."""
    found = re.findall(rf"^( *)```{language}\n(.*?)^\1```", TEXT, re.DOTALL | re.MULTILINE)
    return [textwrap.dedent(code) for _, code in found]


def file(name):
    """The code block whose first line says that name."""
    language = "yaml" if name.endswith(".yaml") else "python"
    (code,) = (code for code in blocks(language) if code.startswith(f"# {name}\n"))
    return code


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """The lab's package as pip would install it: modules, and metadata with entry points."""
    (project,) = (tomllib.loads(code) for code in blocks("toml"))
    name, version = project["project"]["name"], project["project"]["version"]
    package = tmp_path / "us_sim_lab"
    package.mkdir()
    (package / "__init__.py").write_text("")
    for module in ("winkler.py", "udp_input.py"):
        (package / module).write_text(file(module))
    metadata = tmp_path / f"{name.replace('-', '_')}-{version}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (metadata / "entry_points.txt").write_text(
        "".join(
            f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in points.items())
            for group, points in project["project"]["entry-points"].items()
        )
    )
    for scene in ("winkler.yaml", "upper_arm_udp.yaml"):
        (tmp_path / scene).write_text(file(scene))
    monkeypatch.syspath_prepend(str(tmp_path))
    for choice in (SOLVERS, TRACKERS):
        choice.__dict__.pop("options", None)  # what is installed is looked up once
    yield tmp_path
    for choice in (SOLVERS, TRACKERS):
        choice.__dict__.pop("options", None)
    for module in [name for name in sys.modules if name.startswith("us_sim_lab")]:
        del sys.modules[module]


@pytest.fixture
def bench():
    """A bench that is taken down after the test."""
    bench = Bench()
    try:
        yield bench
    finally:
        bench.close()


def names_of(code):
    """The names that a code block defines."""
    names: dict = {}
    exec(code, names)
    return names


@pytest.mark.usefixtures("installed")
def test_the_solvers_test_holds():
    test = names_of(file("test_winkler.py"))["test_a_flat_probe_feels_every_spring_alike"]
    (mark,) = test.pytestmark
    for depth in mark.args[1]:
        test(depth)


@pytest.mark.usefixtures("installed")
def test_the_solvers_equations_hold_and_its_entry_can_be_made():
    equations = names_of(file("foundation_equations.py"))["foundation_equations"]
    (entry,) = (code for code in blocks("python") if code.startswith("EvaluatedMethod("))
    known = {"EvaluatedMethod": EvaluatedMethod, "foundation_equations": equations}
    method = eval(entry, known)
    for setting in method.settings:
        solver = create_solver(method.name, TissueModel.make_block(nodes=(21, 21, 6)), **setting)
        forces = method.equations(solver.model)
        for depth in (0.004, 0.008):
            deformation = solver.deform(Pose(position=[0.003, 0.0, depth]))
            assert len(deformation.contact_nodes) > 3
            unbalanced, _, load = bound_imbalance(solver.model, forces, deformation)
            assert unbalanced < 1e-9 * load
        pushed = deformation.nodes.copy()
        pushed[solver.model.movable_contact_nodes, 0] += 0.004
        moved = replace(deformation, nodes=pushed)
        unbalanced, _, load = bound_imbalance(solver.model, forces, moved)
        assert unbalanced > 0.1 * load


def test_a_scene_runs_with_the_solver_and_it_is_set_by_a_parameter(installed, capsys):
    scene = str(installed / "winkler.yaml")
    given = "tissue_deformer.winkler.spring=40 N/m"
    assert main(["run", scene, "--dry-run", "--param", given]) == 0
    assert "runs      tissue_deformer" in capsys.readouterr().out
    assert main(["run", scene, "--dry-run", "--param", given.replace("N/m", "mm")]) == 1
    assert "winkler.spring: '40 mm' is not a stiffness" in capsys.readouterr().err
    assert main(["reference", "tissue.settings"]) == 0
    assert "### tissue.settings.winkler" in capsys.readouterr().out


def test_a_scene_with_a_wrong_setting_of_the_solver_is_refused(installed, capsys):
    scene = installed / "winkler.yaml"
    scene.write_text(scene.read_text().replace("spring:", "sprnig:"))
    assert main(["run", str(scene), "--dry-run"]) == 1
    error = capsys.readouterr().err
    assert "tissue.settings.winkler.sprnig: unknown key; did you mean `spring`?" in error


def test_the_tissue_node_deforms_with_the_solver_and_changes_its_stiffness(installed, bench):
    scene = str(installed / "winkler.yaml")
    node = bench.make(TissueDeformer, scene=scene, lockstep=True)
    wrenches = bench.collect(WrenchStamped, "probe/wrench")
    publisher = bench.publisher(PoseStamped, "probe/pose")
    bench.spin_until(lambda: bench.peer.count_publishers("probe/wrench") > 0)
    for second, stiffness in ((1, 30.0), (2, 60.0)):
        assert node.set_parameters([Parameter("winkler.spring", value=stiffness)])[0].successful
        publisher.publish(pose_at(0.005, second))
        bench.spin_until(lambda count=second: len(wrenches) == count)
    first, second = (message.wrench.force.z for message in wrenches)
    assert first < -1.0
    assert second == pytest.approx(2 * first)


def test_a_scene_runs_with_the_source(installed, capsys):
    assert main(["run", str(installed / "upper_arm_udp.yaml"), "--dry-run"]) == 0
    assert "poses come from `udp`" in capsys.readouterr().out


def test_the_sources_test_holds(installed, bench):
    test = names_of(file("test_udp_input.py"))["test_packets_move_the_probe_and_nonsense_does_not"]
    test(bench, str(installed / "upper_arm_udp.yaml"))
