"""The bags that are offered for a replay."""

import pytest

from us_sim.recording.writer import BagWriter
from us_sim.run.background import bags_in_reach


@pytest.mark.parametrize("recordings", ["work/rec", "rec"])
def test_every_recording_of_a_folder_is_offered_once(tmp_path, monkeypatch, recordings):
    (tmp_path / "work" / "split").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "work")
    folder = tmp_path / recordings
    folder.mkdir()
    BagWriter(folder / "t1.mcap").close()
    BagWriter(folder / "t2.mcap", sidecar=False).close()
    BagWriter(tmp_path / "work" / "split" / "a.mcap").close()
    offered = bags_in_reach(str(folder))
    own = {name for name, file in offered.items() if str(tmp_path) in file}
    assert own >= {"rec/t1.mcap", "rec/t2.mcap", "split"}
    assert len(own) == len({offered[name] for name in own}) <= 4
