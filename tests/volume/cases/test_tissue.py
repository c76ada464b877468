"""The kept tissue: what was written is read, and nothing else is."""

import numpy as np
import pytest

from us_sim.errors import CaseError
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
from us_sim.volume.cases.tissue import CaseTissue, read_tissue, write_tissue


@pytest.fixture
def tissue():
    mesh = box_mesh([0.0, 0.01, 0.03], [0.0, 0.01], [0.0, 0.02])
    fractions = np.linspace(0.1, 0.9, len(mesh.tetrahedra))
    fractions = np.column_stack([fractions, 1 - fractions])
    return CaseTissue(mesh, np.array([0, 6], np.uint8), fractions, {"nodes": 12, "labels": "ab"})


def test_tissue_is_read_as_it_was_written(tmp_path, tissue):
    write_tissue(tmp_path / "tissue.npz", tissue)
    again = read_tissue(tmp_path / "tissue.npz")
    np.testing.assert_array_equal(again.mesh.nodes, tissue.mesh.nodes)
    np.testing.assert_array_equal(again.mesh.tetrahedra, tissue.mesh.tetrahedra)
    np.testing.assert_array_equal(again.mesh.planes[0], [0.0, 0.01, 0.03])
    np.testing.assert_allclose(again.fractions, tissue.fractions, atol=1e-7)
    np.testing.assert_allclose(again.fractions.sum(axis=1), 1.0, rtol=1e-14)
    assert again.made_from == tissue.made_from
    assert [path.name for path in tmp_path.iterdir()] == ["tissue.npz"]


def test_what_is_no_tissue_is_refused_in_a_sentence(tmp_path, tissue):
    path = tmp_path / "tissue.npz"
    write_tissue(path, tissue)
    whole = path.read_bytes()
    for content in (b"nothing", whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(CaseError, match="remove it"):
            read_tissue(path)
    np.savez(path, nodes=np.zeros((4, 3)))
    with pytest.raises(CaseError, match="us_sim wrote"):
        read_tissue(path)
