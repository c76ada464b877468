"""Moduli of known presses are found within their intervals; landmarks; refused inputs."""

from dataclasses import replace

import numpy as np
import pytest
from known_press import TRUE, KnownPress, layered_block, slide

from us_sim.command.stiffness_report import table
from us_sim.errors import StiffnessError
from us_sim.geometry.collider import RoundedBox
from us_sim.geometry.pose import Pose
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import LabelFractions, average_over_labels
from us_sim.tissue.identification.press_model import PressModel
from us_sim.tissue.identification.press_record import ChosenPoses, paired, without_wrench
from us_sim.tissue.identification.settings import StiffnessSettings
from us_sim.tissue.identification.stiffness import Landmarks, Tissue, fit_stiffness, read_landmarks
from us_sim.tissue.mesh.embedding import locate
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.tissue.model import TissueModel, face_nodes

FEW = StiffnessSettings(poses=16)


@pytest.mark.slow
def test_moduli_are_within_5_percent_with_1_percent_noise_and_within_their_intervals(press, random):
    inside = 0
    for _ in range(3):
        found = fit_stiffness(press.tissue, press.record(press.noisy(0.01, random)), FEW)
        for name, true in press.moduli.items():
            assert found.moduli[name] == pytest.approx(true, rel=0.05)
            inside += found.intervals[name].lower <= true <= found.intervals[name].upper
        assert found.scatter("force") == pytest.approx(0.01 * 3.5, rel=0.4)
    assert inside >= 5  # of 6


@pytest.mark.slow
def test_a_sensor_without_torque_will_do(press, random):
    felt = press.noisy(0.01, random)
    felt[:, 3:] = 0.0
    found = fit_stiffness(press.tissue, press.record(felt), FEW)
    for name, true in press.moduli.items():
        assert found.moduli[name] == pytest.approx(true, rel=0.1)
    assert any("no torque" in remark for remark in found.remarks)


@pytest.mark.slow
def test_a_stiffening_is_found_beside_the_moduli(random):
    plain = layered_block()

    def materials_for(moduli):
        made = plain.materials_for(moduli)
        return replace(made, stiffening=np.full(len(made.density), moduli["stiffening of fat"]))

    start = {**plain.moduli, "stiffening of fat": 0.5}
    tissue = Tissue(plain.model, materials_for, start, {"stiffening of fat": "fat"})
    true = {**TRUE, "stiffening of fat": 4.0}
    path = slide()
    path.positions[:, 2] *= 1.6  # to 14 mm, where it acts
    press = KnownPress(tissue, true, path)
    found = fit_stiffness(tissue, press.record(press.noisy(0.01, random)), FEW)
    for name, value in true.items():
        assert found.moduli[name] == pytest.approx(value, rel=0.3 if "of" in name else 0.1)
    assert found.constants["fat"] == {
        "young_modulus": found.moduli["fat"],
        "stiffening": found.moduli["stiffening of fat"],
    }
    assert "kept" not in table(found)


@pytest.mark.slow
def test_two_springs_in_series_are_told_as_one_and_either_from_the_other():
    """A column of two layers under a plate: F = A d / (h1 / E1 + h2 / E2)."""
    side, height = 0.04, 0.06
    across, deep = uniform_planes(-side / 2, side / 2, 4), uniform_planes(0.0, height, 7)
    mesh = box_mesh(across, across, deep)
    lower = mesh.nodes[mesh.tetrahedra][:, :, 2].mean(axis=1) > 0.02
    fractions = LabelFractions(np.arange(2, dtype=np.uint8), np.eye(2)[lower.astype(int)])
    fixed = np.zeros(len(mesh.nodes), dtype=bool)
    fixed[face_nodes(mesh, "bottom")] = True

    def materials_for(moduli):
        return average_over_labels(
            fractions, {k: Material(moduli[name], 0.0) for k, name in enumerate(("top", "base"))}
        )

    start = {"top": 8e3, "base": 20e3}
    plate = RoundedBox(length=0.1, width=0.1, height=0.03, rounding=0.001)
    model = TissueModel(mesh, materials_for(start), fixed, plate, face_nodes(mesh, "top"))
    column = Tissue(model, materials_for, start)
    depth = 0.0012 * np.sin(np.pi * np.linspace(0, 1, 61)) ** 2
    true = {"top": 5e3, "base": 20e3}
    force = side**2 * depth / (0.02 / true["top"] + 0.04 / true["base"])
    force += 1e-4 * force.max() * np.sin(np.arange(61) ** 2)
    stamps = np.arange(61) * 50_000_000
    poses = stamps, np.outer(depth, [0, 0, 1]), np.tile([0.0, 0, 0, 1], (61, 1))
    record = paired(poses, (stamps, np.outer(force, [0, 0, -1, 0, 0, 0])), tolerance=0.01)
    found = fit_stiffness(column, record, StiffnessSettings(poses=14, keep=("base",)))
    assert found.moduli["top"] == pytest.approx(true["top"], rel=0.04)  # the probe sinks in a bit
    assert found.intervals["top"].factor < 1.05
    with pytest.raises(StiffnessError, match=r"(base|top) .* from (top|base)"):
        fit_stiffness(column, record, StiffnessSettings(poses=14))


@pytest.mark.slow
def test_a_structure_that_no_force_reaches_is_refused_by_name(press, random):
    tissue = press.tissue

    def with_bone(moduli):
        made = tissue.materials_for(moduli)
        modulus = made.young_modulus.copy()
        modulus[-1] = moduli["bone"]  # in a corner of the face that is held
        return replace(made, young_modulus=modulus)

    more = Tissue(tissue.model, with_bone, {**tissue.moduli, "bone": 1e5})
    record = press.record(press.noisy(0.01, random))
    with pytest.raises(StiffnessError, match="--keep bone"):
        fit_stiffness(more, record, FEW)
    found = fit_stiffness(more, record, replace(FEW, keep=("bone",)))
    assert found.moduli["bone"] == 1e5
    assert "bone" not in found.intervals


@pytest.mark.slow
def test_another_mesh_than_the_one_that_made_the_forces_is_said_in_the_residual(press, random):
    record = press.record(press.noisy(0.001, random))
    own = fit_stiffness(press.tissue, record, FEW)
    other = fit_stiffness(layered_block((8, 8, 8)), record, FEW)
    assert other.scatter("force") > 1.5 * own.scatter("force")
    for name, true in press.moduli.items():
        assert other.moduli[name] == pytest.approx(true, rel=0.35)
        assert other.intervals[name].factor > own.intervals[name].factor


def seen_by(press: KnownPress) -> Landmarks:
    """Where four points of the block are at five moments of the press."""
    mesh = press.tissue.model.mesh
    rest = np.array([[0.0, 0, 0.01], [0.01, 0.01, 0.02], [-0.01, 0, 0.025], [0.02, -0.01, 0.03]])
    poses = np.array([30, 45, 60, 75, 90])
    located = locate(mesh, rest)
    whole = PressModel(press.tissue.model, press.tissue.materials_for, [], [])
    solver = whole.solver(press.moduli)
    places = []
    for k in poses:
        moved = whole.balanced(solver, Pose(press.path.positions[k]), 0)
        nodes = mesh.tetrahedra[located.tetrahedra]
        places.append(rest + np.einsum("la,lax->lx", located.weights, moved[nodes]))
    times = (press.path.stamps[poses] - press.path.stamps[0]) / 1e9
    return Landmarks(
        ("a", "b", "c", "d"), rest, np.tile(np.arange(4), 5), np.repeat(times, 4), np.vstack(places)
    )


@pytest.mark.slow
def test_landmarks_alone_tell_ratios_and_refuse_the_scale(press):
    path = press.path
    record = without_wrench((path.stamps, path.positions, path.orientations))
    with pytest.raises(StiffnessError, match="only ratios"):
        fit_stiffness(press.tissue, record, FEW, seen_by(press))
    start = replace(press.tissue, moduli={"fat": 10e3, "muscle": press.moduli["muscle"]})
    few = replace(FEW, poses=12, keep=("muscle",))
    found = fit_stiffness(start, record, few, seen_by(press))
    assert found.moduli["fat"] == pytest.approx(press.moduli["fat"], rel=0.02)
    assert found.scatter("landmark") < 1e-5


@pytest.mark.parametrize(
    ("keep", "sign", "sentence"),
    [
        (("skin",), 1.0, "fat, muscle"),
        (("fat", "muscle"), 1.0, "nothing to fit"),
        (("fat",), -1.0, "other way"),
    ],
)
def test_what_cannot_be_fitted_is_refused(press, keep, sign, sentence):
    record = press.record(sign * press.felt)
    with pytest.raises(StiffnessError, match=sentence):
        fit_stiffness(press.tissue, record, replace(FEW, keep=keep))


GOOD = "name,time,x,y,z\nvein,,0,0,10 mm\nvein,0.5,0,0,12 mm\n"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("name,x,y,z\n", "column time"),
        ("name,time,x,y,z\nvein,,0,0,1 kg\n", "line 2: .*1 kg"),
        ("name,time,x,y,z\nvein,1,0,0,0.01\n", "at rest"),
        ("name,time,x,y,z\nvein,,0,0,0.01\n", "nothing was seen"),
        ("name,time,x,y,z\nvein,,0,0,0.01\nvein,,0,0,0.02\n", "at rest twice"),
        ("name,time,x,y,z\nvein,,0,0\n", "line 2"),
    ],
)
def test_what_is_no_list_of_landmarks_is_refused(tmp_path, text, sentence):
    file = tmp_path / "seen.csv"
    file.write_text(text)
    with pytest.raises(StiffnessError, match=sentence):
        read_landmarks(file)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(StiffnessError, match=r"none\.csv"):
        read_landmarks(tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (GOOD.replace("0.5", "9"), "within 10 ms"),
        (GOOD.replace("10 mm", "-40 mm"), "40.0 mm outside"),
        (GOOD.replace("0.5", "0.0"), "no landmark"),
    ],
)
def test_landmarks_must_fit_the_press_and_the_tissue(tmp_path, press, text, sentence):
    file = tmp_path / "seen.csv"
    file.write_text(text)
    path = press.path
    record = without_wrench((path.stamps, path.positions, path.orientations))
    apart = -path.positions[:, 2] + 0.02
    apart[0] = 0.01
    apart[10] = -0.005
    chosen = ChosenPoses(np.array([10]), np.array([0]), apart)
    with pytest.raises(StiffnessError, match=sentence):
        read_landmarks(file).at(record, chosen, press.tissue.model.mesh, 0.01)


POSE = Pose([0.004, 0.003, 0.008], [0.05, 0.02, 0.0, 1.0])


@pytest.fixture(scope="module")
def felt(press):
    tissue = press.tissue

    def felt(moduli):
        return PressModel(tissue.model, tissue.materials_for, list(moduli), [POSE]).predict(moduli)

    return felt


def test_slopes_are_those_between_presses_with_other_moduli(press, felt):
    here, step = felt(press.moduli), 0.01
    for p, name in enumerate(press.moduli):
        more, less = (
            felt({**press.moduli, name: press.moduli[name] * np.exp(change)}).wrenches[0]
            for change in (step, -step)
        )
        between = (more - less) / (2 * step)
        assert np.allclose(here.slopes[0, :, p], between, atol=2e-3 * np.abs(between).max())


def test_all_moduli_twice_as_large_make_twice_the_force(press, felt):
    here = felt(press.moduli)
    twice = felt({name: 2 * modulus for name, modulus in press.moduli.items()})
    assert np.allclose(twice.wrenches, 2 * here.wrenches, rtol=1e-4, atol=1e-6)
    # Euler's theorem on homogeneous functions: the slopes add up to the function.
    assert np.allclose(here.slopes.sum(axis=2), here.wrenches, rtol=1e-3, atol=1e-4)
