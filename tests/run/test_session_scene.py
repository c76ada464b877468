"""The scene of a session, and a sentence where it or one of its files is not there."""

import numpy as np
import pytest
from session_files import press, write

from us_sim.errors import BagError
from us_sim.nodes.sessions.attachments import collect_attachments
from us_sim.nodes.settings import SessionRecorderSettings
from us_sim.recording.reader import read_bag
from us_sim.run.session_summary import unpack_scene
from us_sim.volume.files.writing import write_volume
from us_sim.volume.volume import Volume


@pytest.fixture
def volume(tmp_path):
    """A file that is too large to be attached."""
    voxels = np.random.default_rng(1).integers(0, 255, (180, 180, 180), dtype=np.uint8)
    write_volume(tmp_path / "large.nrrd", Volume(voxels, np.diag([5e-4, 5e-4, 5e-4, 1.0])))
    return tmp_path / "large.nrrd"


def session_of(tmp_path, volume):
    scene = tmp_path / "plain.yaml"
    probe = "{aperture: 40 mm, depth: 30 mm}"
    scene.write_text(f"name: plain\nvolume: {{file: {volume.name}}}\nprobe: {probe}\n")
    attached = collect_attachments(SessionRecorderSettings(scene=str(scene)))
    contents = {name: data for name, (_, data) in attached.items()}
    return read_bag(write(tmp_path / "session.mcap", press(30), contents))


def test_it_names_the_volume_where_that_is(tmp_path, volume):
    with unpack_scene(session_of(tmp_path, volume)) as scene:
        assert (scene.name, scene.volume.file) == ("plain", str(volume))


@pytest.mark.parametrize("change", [lambda file: file.unlink(), lambda file: file.write_text("x")])
def test_a_volume_that_is_gone_or_another_is_refused(tmp_path, volume, change):
    session = session_of(tmp_path, volume)
    change(volume)
    with pytest.raises(BagError, match=r"large\.nrrd"), unpack_scene(session):
        pass


def test_a_session_without_a_scene_is_refused(tmp_path):
    with (
        pytest.raises(BagError, match="scene"),
        unpack_scene(read_bag(write(tmp_path / "session.mcap", press(30), {}))),
    ):
        pass
