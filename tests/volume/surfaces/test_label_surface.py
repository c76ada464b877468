"""Surfaces of labels: closed, outward, of the labels' own volume; and labels that have none."""

import meshio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from us_sim.errors import VolumeError
from us_sim.skin.surface import read_surface
from us_sim.volume.phantom.phantom import load_or_make_phantom
from us_sim.volume.surfaces.label_surface import (
    choose_spacing,
    compute_enclosed_volume,
    make_label_surface,
    write_stl,
)
from us_sim.volume.volume import Volume


def labelled(mask, affine=None, label=3):
    labels = np.where(mask, np.uint8(label), np.uint8(1))
    placed = np.diag([1e-3, 1e-3, 1e-3, 1.0]) if affine is None else affine
    return Volume(np.zeros_like(labels), placed, labels=labels, label_names={1: "fat", 3: "vein"})


def require_closed(triangles):
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    there = {tuple(edge) for edge in edges.tolist()}
    assert len(there) == len(edges)
    assert all((b, a) in there for a, b in there)


@given(
    radius=st.floats(5.0, 12.0),
    steps=st.tuples(*[st.floats(0.5e-3, 1.5e-3)] * 3),
    mirrored=st.booleans(),
    seed=st.integers(0, 2**16),
)
@settings(max_examples=12, deadline=None)
def test_a_ball_keeps_its_volume_and_faces_outwards(radius, steps, mirrored, seed):
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    turn[:, 0] *= np.sign(np.linalg.det(turn)) * (-1 if mirrored else 1)
    affine = np.eye(4)
    affine[:3, :3] = turn * steps
    affine[:3, 3] = [0.1, -0.2, 0.3]
    mask = ((np.indices((32, 32, 32)) - 15.3) ** 2).sum(axis=0) < radius**2
    volume = labelled(mask, affine)
    vertices, triangles = make_label_surface(volume, 3)
    require_closed(triangles)
    assert compute_enclosed_volume(vertices, triangles) == pytest.approx(
        mask.sum() * np.prod(steps), rel=0.01
    )
    centre = affine[:3, :3] @ np.full(3, 15.3) + affine[:3, 3]
    np.testing.assert_allclose(vertices.mean(axis=0), centre, atol=0.3 * max(steps))


@given(
    mask=arrays(bool, st.tuples(*[st.integers(2, 7)] * 3)),
    steps=st.tuples(*[st.floats(0.2e-3, 2e-3)] * 3),
    mirrored=st.booleans(),
)
@settings(max_examples=40, deadline=None)
def test_any_labels_have_a_closed_surface_that_faces_outwards(mask, steps, mirrored):
    mask.flat[0] = True
    affine = np.diag([*steps, 1.0])
    affine[0] *= -1 if mirrored else 1
    vertices, triangles = make_label_surface(labelled(mask, affine), 3)
    require_closed(triangles)
    assert compute_enclosed_volume(vertices, triangles) > 0.0


CORNERS = np.array([[0.01, 0.02, 0.03], [0.05, 0, 0], [0, 0.061, 0], [0, 0, 0.0723]])


def test_meshio_and_the_scenes_reader_find_the_same_surface_in_millimetres(tmp_path):
    path, triangles = tmp_path / "vein.stl", np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    write_stl(path, CORNERS, triangles)
    there = meshio.read(path)
    for vertices in (there.points * 1e-3, read_surface(path, 1e-3).vertices):
        np.testing.assert_allclose(np.sort(vertices, axis=0), np.sort(CORNERS, axis=0), atol=1e-8)
    found = compute_enclosed_volume(there.points * 1e-3, there.cells_dict["triangle"])
    assert found == pytest.approx(compute_enclosed_volume(CORNERS, triangles), rel=1e-5)
    assert b"SPACE=LPS" in path.read_bytes()[:80]


@pytest.mark.slow
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_structures_of_the_arm_keep_their_volume_within_the_triangles_allowed():
    arm = load_or_make_phantom("upper_arm", seed=1, voxel_size=0.6e-3)
    labels = [n for n, name in arm.label_names.items() if name in ("vein", "artery", "bone")]
    for allowed in (30_000, 15_000):
        spacing = choose_spacing(arm, labels, allowed)
        made = [make_label_surface(arm, label, spacing) for label in labels]
        assert sum(len(faces) for _, faces in made) == pytest.approx(allowed, rel=0.1)
        for label, (vertices, triangles) in zip(labels, made, strict=True):
            voxels = np.count_nonzero(arm.labels == label) * 0.6e-3**3
            assert compute_enclosed_volume(vertices, triangles) == pytest.approx(voxels, rel=0.03)


def test_a_box_cuts_and_caps():
    mask = np.zeros((30, 60, 30), bool)
    mask[10:20, :, 10:20] = True
    box = np.array([[-1.0, 0.0205, -1.0], [1.0, 0.0405, 1.0]])
    vertices, triangles = make_label_surface(labelled(mask), 3, within=box)
    require_closed(triangles)
    assert compute_enclosed_volume(vertices, triangles) == pytest.approx(
        10 * 20 * 10 * 1e-9, rel=0.01
    )
    np.testing.assert_allclose([vertices[:, 1].min(), vertices[:, 1].max()], box[:, 1], atol=2e-4)


SMALL = labelled(np.pad(np.ones((2, 2, 2), bool), 5))
BARE = Volume(SMALL.intensities, SMALL.index_to_patient)


@pytest.mark.parametrize(
    ("volume", "label", "how", "message"),
    [
        (SMALL, 9, {}, "label 9"),
        (SMALL, 3, {"within": np.array([[1.0] * 3, [2.0] * 3])}, r"\(vein\) .*within"),
        (SMALL, 3, {"spacing": 5e-3}, r"\(vein\) .*thin"),
        (BARE, 3, {}, "no labels"),
    ],
)
def test_what_has_no_surface_is_said(volume, label, how, message):
    with pytest.raises(VolumeError, match=message):
        make_label_surface(volume, label, **how)
