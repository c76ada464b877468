"""The bags that are offered for a replay."""

import pytest

from us_sim.recording.writer import BagWriter
from us_sim.run.background import bags_in_reach


@pytest.mark.parametrize("recordings", ["work/rec", "rec"])
def test_every_recording_of_a_folder_is_offered_once(tmp_path, monkeypatch, recordings):
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    folder = tmp_path / recordings
    folder.mkdir()
    BagWriter(folder / "t1.mcap").close()
    for name in ("t2.mcap", "t3.mcap"):
        BagWriter(folder / name, sidecar=False).close()
    offered = bags_in_reach(str(folder))
    assert {name: file for name, file in offered.items() if str(tmp_path) in file} == {
        "rec": str(folder),
        "rec/t2.mcap": str(folder / "t2.mcap"),
        "rec/t3.mcap": str(folder / "t3.mcap"),
    }
