"""Errors and faults of a method in a hand, of solvers of which they are known beforehand."""

import csv
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from us_sim.evaluation.hand import measure as following
from us_sim.evaluation.hand import report as hand
from us_sim.evaluation.hand.hand_motion import KINDS, HandMotion
from us_sim.evaluation.hand.measure import (
    CONVERGED,
    FIRST,
    ArmMotion,
    ConvergedAnswer,
    follow_motion,
    follow_to_convergence,
)
from us_sim.evaluation.tissue_methods import TISSUE_METHODS
from us_sim.geometry.pose import Pose
from us_sim.tissue.model import Deformation, TissueModel
from us_sim.tissue.solvers.fem_cg import FemCg

MODEL = TissueModel.make_block(nodes=(5, 5, 4))
MOTION = ArmMotion("pressing", "brisk", 8, 0.5)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """A tissue that costs nothing."""
    monkeypatch.setattr(following, "load_arm", lambda: MODEL)
    shallow = HandMotion("down and up", (0.0, 0.0, -0.002), (0.0, 0.0, 0.008))
    for kind in ("free", "pressing"):
        monkeypatch.setitem(KINDS, kind, shallow)


def answer():
    """An answer that is as simple as can be: the tissue moves down with the pose's number."""
    count = len(MOTION.poses)
    nodes = MODEL.mesh.nodes + 1e-5 * np.arange(count)[:, None, None] * [0.0, 0.0, 1.0]
    nodes[:, MODEL.fixed] = MODEL.mesh.nodes[MODEL.fixed]
    return ConvergedAnswer(nodes, np.zeros(count))


class Oracle:
    """Knows the answer at each pose, but for what a test wants to be wrong."""

    name = "fem"
    model = MODEL

    def __init__(self, known, *, spoil=lambda nodes: nodes, takes=0.0):
        self.known, self.spoil, self.takes = known, spoil, takes
        self.seen, self.clock = [], 0.0

    def reset(self):
        self.seen = []

    def deform(self, pose):
        nodes = MODEL.mesh.nodes.copy()
        if pose is not None:
            number = next(k for k, own in enumerate(MOTION.poses) if own is pose)
            self.seen.append(number)
            nodes = self.spoil(self.known.nodes[number].copy())
        self.clock += self.takes
        return Deformation(nodes, np.zeros(1, np.int32), np.zeros(3), np.zeros(3), 0.0)


def test_what_knows_the_answer_has_no_error_and_skips_nothing(monkeypatch):
    live_by_its_own_clock(monkeypatch, solver := Oracle(answer()))
    row = follow_motion(solver, MOTION, answer())
    assert row["frames"] == len(MOTION.poses) - FIRST == 30
    assert row["error_mm_worst"] == row["live_skipped"] == row["frames_inverted"] == 0.0


def test_what_has_not_converged_is_compared_with_nothing():
    known = answer()
    known.residual[FIRST + 4 :] = 0.1
    row = follow_motion(Oracle(known), MOTION, known)
    assert row["not_compared"] == 26
    assert row["error_mm_worst"] == 0.0


def test_inverted_tetrahedra_are_seen_in_the_nodes():
    def crushed(nodes):
        nodes[:, 2] *= -1.0
        return nodes

    row = follow_motion(Oracle(answer(), spoil=crushed), MOTION, answer())
    assert set(row["every"]["inverted"]) == {len(MODEL.mesh.tetrahedra)}
    assert row["frames_inverted"] == 30
    assert row["live_frames_inverted"] == 30


def live_by_its_own_clock(monkeypatch, solver):
    """Only frames take time, and each what the solver says."""
    clock = SimpleNamespace(perf_counter=lambda: solver.clock, process_time=lambda: 0.0)
    monkeypatch.setattr(following, "time", clock)


def test_live_the_newest_pose_wins(monkeypatch):
    # 40 ms a frame at 60 Hz: the first pose at 0, then those that came last by 40, 80, 120 ms.
    solver = Oracle(answer(), takes=0.040)
    live_by_its_own_clock(monkeypatch, solver)
    row = follow_motion(solver, MOTION, answer())
    expected = [int(0.040 * k * 60 + 1e-6) for k in range(25)]
    assert solver.seen == expected
    counted = [k for k in expected if k >= FIRST]
    assert row["live"]["number"].tolist() == counted
    assert row["live_skipped"] == pytest.approx(1 - len(counted) / 30)
    # A pose waits for the frame before, and then for its own.
    waits = [1e3 * (0.040 * (k + 1) - expected[k] / 60) for k in range(25)]
    assert row["live"]["latency"].to_numpy() == pytest.approx(waits[-len(counted) :])
    assert set(row["live"]["error"]) == {0.0}


@pytest.mark.slow
def test_the_converged_answer_does_not_depend_on_the_way():
    straight = [Pose(position=[0.0, 0.0, 0.008])]
    around = [Pose(position=[x, 0.0, z]) for x, z in ((0.004, 0.004), (0.002, 0.01))] + straight
    found = follow_to_convergence(MODEL, around)
    assert found.residual.max() <= CONVERGED
    assert found.nodes[-1] == pytest.approx(
        follow_to_convergence(MODEL, straight).nodes[-1], abs=2e-7
    )


class Raising(FemCg):
    """Raises what no user understands."""

    def _advance(self, _):
        raise np.linalg.LinAlgError("Singular matrix")


@pytest.mark.slow
def test_the_report_has_a_row_for_each_method_and_says_what_broke(tmp_path, monkeypatch, capsys):
    for name in {*TISSUE_METHODS} - {"fem", "fem_cg", "fem_nonlinear"}:
        monkeypatch.delitem(TISSUE_METHODS, name)
    made = following.create_solver
    monkeypatch.setattr(
        following,
        "create_solver",
        lambda name, m, **s: Raising(m) if name == "fem_cg" else made(name, m, **s),
    )
    monkeypatch.setattr(Raising, "warm_up", lambda _: None)
    monkeypatch.setattr(
        hand, "list_motions", lambda _, seed: [replace(MOTION, kind="free", seed=seed)]
    )
    assert hand.HAND(tmp_path / "out", True) == 1
    with (tmp_path / "out" / "hand.csv").open(newline="", encoding="utf-8") as stream:
        rows = {row["method"]: row for row in csv.DictReader(stream)}
    assert rows["fem_cg"]["failure"] == "LinAlgError: Singular matrix"
    # Linear strain is off by a tenth of a millimetre of 8, and the judged method by its haste.
    assert float(rows["fem_nonlinear"]["error_mm_worst"]) < 0.5
    assert float(rows["fem"]["error_mm_worst"]) > 0.1
    report = (tmp_path / "out" / "hand.md").read_text(encoding="utf-8")
    assert (tmp_path / "out" / "hand_error.png").stat().st_size > 10_000
    assert "hand_error.png" in report
    assert "LinAlgError: Singular matrix" in report
    assert "failed: free" in capsys.readouterr().out
