"""Velocities in images: Poiseuille's rate through a plane, the angle's cosine, continuity."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tubes import ARTERY, RADIUS, SIDES, VEIN, block, tube_vessel, tube_volume

from us_sim.errors import SceneError
from us_sim.geometry.pose import Pose
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.flow.blood import Blood, PixelWindow
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, SectorProbe

PROBE = LinearProbe(aperture=0.018, depth=0.025, columns=180, rows=250)
LOWERED = -2e-3  # m, so that a tilted plane begins above the volume


@pytest.fixture(scope="module")
def volume():
    return tube_volume()


@pytest.fixture(scope="module")
def scanner(volume):
    made = BMode(volume, PROBE)
    made.attach_mesh(block().nodes, block().tetrahedra)
    return made


@pytest.fixture(scope="module")
def vein(volume):
    return tube_vessel(VEIN, volume)


@pytest.fixture(scope="module")
def artery(volume):
    return tube_vessel(ARTERY, volume)


def tilted(degrees, y=0.0):
    """Upright over the tube, turned about the array, so that beams lean along it."""
    half = np.radians(degrees) / 2
    middle = 0.5 * SIDES[2] - LOWERED
    return Pose([0.0, y + middle * np.tan(np.radians(degrees)), LOWERED],
                [np.sin(half), 0.0, 0.0, np.cos(half)])  # fmt: skip


def beams(probe=PROBE):
    """All pixels, seen along beams that are not steered."""
    return PixelWindow(probe, np.zeros((probe.rows, probe.columns)))


def flow_through(frame, velocity, along):
    """m³/s through the image's plane, of velocities along its beams and a known direction."""
    rotation = frame.pose.rotation
    speed = velocity / -(rotation[:, 2] @ along)
    pixel = np.prod(frame.probe.pixel_spacing)
    return np.nansum(speed) * (rotation[:, 1] @ along) * pixel


@pytest.mark.parametrize("degrees", [10, 20, 40, -30])
@pytest.mark.parametrize("squeezed", [1.0, 0.6])
def test_the_rate_through_a_plane_is_that_of_poiseuille(scanner, artery, degrees, squeezed):
    blood = Blood([artery])
    nodes = block().nodes * [1.0, 1.0, squeezed] + [0.0, 0.0, 0.5 * SIDES[2] * (1 - squeezed)]
    for time in (0.0, 0.2):  # at rest, and at another moment of the pulse
        frame = scanner.make_frame(tilted(degrees), nodes, time=time)
        velocity = blood.compute_velocity(frame, beams())
        rate = flow_through(frame, velocity, np.array([0.0, 1.0, 0.0]))
        expected = artery.flow * float(artery.evaluate_pulse(time))
        assert rate == pytest.approx(expected, rel=0.03)
        whole = ARTERY.mean_velocity * np.pi * RADIUS**2 * float(artery.evaluate_pulse(time))
        assert rate == pytest.approx(whole, rel=0.03)


def test_the_angle_between_beam_and_vessel_counts_by_its_cosine(scanner, artery):
    blood, seen = Blood([artery]), {}
    for degrees in (5, 15, 30, 45, 60):
        frame = scanner.make_frame(tilted(degrees), block().nodes, time=0.0)
        velocity, _ = blood.compute_mean_velocities(frame, beams())
        seen[degrees] = np.nanmax(np.abs(velocity))
    axis = {degrees: peak / np.sin(np.radians(degrees)) for degrees, peak in seen.items()}
    assert list(axis.values()) == pytest.approx([2 * ARTERY.mean_velocity] * 5, rel=0.02)
    upright = scanner.make_frame(tilted(0), block().nodes, time=0.0)
    across, _ = blood.compute_mean_velocities(upright, beams())
    assert np.nanmax(np.abs(across)) < 0.02 * 2 * ARTERY.mean_velocity


@settings(deadline=None, max_examples=30)
@given(squeeze=st.floats(0.45, 1.0), width=st.floats(5e-3, 12e-3), y=st.floats(-8e-3, 8e-3))
def test_what_flows_in_at_a_narrowing_flows_out(scanner, artery, squeeze, width, y):
    """Continuity: through every plane across the tube the same rate, wherever it is pressed."""
    nodes = block().nodes.copy()
    factor = 1.0 - (1.0 - squeeze) * np.exp(-0.5 * (nodes[:, 1] / width) ** 2)
    nodes[:, 2] = 0.5 * SIDES[2] + (nodes[:, 2] - 0.5 * SIDES[2]) * factor
    blood = Blood([artery])
    frame = scanner.make_frame(tilted(15, y), nodes, time=0.0)
    velocity, _ = blood.compute_mean_velocities(frame, beams())
    rate = flow_through(frame, velocity, np.array([0.0, 1.0, 0.0]))
    assert rate == pytest.approx(artery.flow, rel=0.05)


def test_a_vein_under_a_full_press_shows_none_and_surges_when_it_is_let_go(scanner, vein):
    blood = Blood([vein])
    pressed = block().nodes.copy()
    pressed[:, 2] = 0.5 * SIDES[2] + 0.2 * (pressed[:, 2] - 0.5 * SIDES[2])
    blood.advance_to_frame(scanner.make_frame(tilted(30), block().nodes, time=0.0))
    at_rest = vein.flow
    for time in (1.0, 5.0, 20.0):
        frame = scanner.make_frame(tilted(30), pressed, time=time)
        velocity = blood.compute_velocity(frame, beams())
        assert np.nanmax(np.abs(velocity)) == 0.0
    frame = scanner.make_frame(tilted(30), block().nodes, time=20.1)
    assert np.nanmax(np.abs(blood.compute_velocity(frame, beams()))) > 0.0
    assert vein.flow > 2.5 * at_rest


@pytest.mark.parametrize(
    "probe",
    [
        ConvexProbe(radius=0.03, opening_angle=1.0, depth=0.025, columns=180, rows=200),
        SectorProbe(aperture=0.01, opening_angle=1.2, depth=0.025, columns=180, rows=200),
    ],
)
def test_beams_that_spread_see_what_flows_along_them(volume, artery, probe):
    """With the tube in the image, across its middle: the sine of each beam's angle."""
    from us_sim.slicing.probe.beams import compute_beam_angles, compute_beam_coordinates

    turned = Pose([0.0, 0.0, 0.0], [0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4)])
    frame = BMode(volume, probe).make_frame(turned, None, time=0.0)
    angles = compute_beam_angles(probe, compute_beam_coordinates(probe)[0])
    velocity, _ = Blood([artery]).compute_mean_velocities(frame, PixelWindow(probe, angles))
    places = frame.plane.compute_pixel_positions()
    x, z = places[..., 1], places[..., 2]  # lateral is along the tube
    behind = probe.radius if isinstance(probe, ConvexProbe) else 0.0
    expected = -0.2 * (1 - ((z - 0.01) / RADIUS) ** 2) * x / np.hypot(x, z + behind)
    inner = (np.abs(z - 0.01) < 0.9 * RADIUS) & ~np.isnan(velocity)
    assert np.count_nonzero(inner) > 3000
    assert velocity[inner] == pytest.approx(expected[inner], abs=0.006)


def test_a_flow_across_its_vessel_is_refused(vein):
    import dataclasses

    across = dataclasses.replace(VEIN, direction=(1.0, 0.1, 0.0))
    with pytest.raises(SceneError, match=r"structures\.vessel\.flow\.direction"):
        vein.find_flow_sign(across)
