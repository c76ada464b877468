"""A demo that is refused before it begins leaves no folder, and harms none that is there."""

import numpy as np
import pytest

from us_sim.errors import SceneError
from us_sim.run.live import demo
from us_sim.run.watch import SupervisionSettings
from us_sim.share import find_bag
from us_sim.volume.files.writing import write_volume
from us_sim.volume.volume import Volume

SCENE = """
name: elsewhere
volume: {file: block.nrrd, pose: {position: [2 m, 0, 0]}}
probe: {aperture: 40 mm, depth: 30 mm, image: [100, 80]}
"""


@pytest.mark.parametrize("mine", [False, True])
def test_an_empty_folder_is_not_left(tmp_path, mine):
    block = Volume(np.ones((9, 9, 9), np.uint8), np.diag([1e-3, 1e-3, 1e-3, 1.0]))
    write_volume(tmp_path / "block.nrrd", block)
    (tmp_path / "scene.yaml").write_text(SCENE)
    out = tmp_path / "some" / "press"
    if mine:
        out.mkdir(parents=True)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SceneError, match="lies beside all images"):
        demo(
            str(tmp_path / "scene.yaml"),
            None,
            out,
            {},
            network=False,
            supervision=SupervisionSettings(),
            path=find_bag("press_and_slide.mcap"),
        )
    assert sorted(tmp_path.rglob("*")) == before
