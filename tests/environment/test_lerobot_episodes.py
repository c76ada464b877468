"""Episodes for LeRobot against the environment that they are of, and against lerobot itself."""

import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import yaml

from us_sim.command.main import main
from us_sim.environment.environment import ScanEnvironment
from us_sim.environment.lerobot_episodes import compute_frame_rate, read_episode
from us_sim.errors import EpisodeError
from us_sim.recording.lerobot_writer import LeRobotEpisode, write_episodes

STEPS = 5
DELAY = 2


@pytest.fixture(scope="module")
def scene(small_scene, tmp_path_factory):
    file = tmp_path_factory.mktemp("scene") / "short.yaml"
    given = {"based_on": str(small_scene), "name": "short", "skin": None}
    draws = {"height": [0.0, 0.0], "delay": [DELAY, DELAY], "position_noise": ["1 mm", "1 mm"]}
    given["episode"] = {"steps": STEPS, "draws": draws}
    file.write_text(yaml.safe_dump(given))
    return str(file)


@pytest.fixture(scope="module")
def made(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("data") / "set"
    assert main(["dataset", scene, "--episodes", "2", "--task", "FindVein", "--out", str(out)]) == 0
    return out


def episode(folder, name="00-short-000001"):
    facts = json.loads((folder / f"{name}.json").read_text())
    return facts, *read_episode(folder / f"{name}.tar", facts)


def test_observations_are_what_the_environment_gave_and_truths_are_of_the_moment(scene, made):
    facts, frames, names = episode(made)
    environment = ScanEnvironment("FindVein", scene)
    observed, _ = environment.reset(seed=facts["seed"])
    for number, frame in enumerate(frames, 1):
        assert np.array_equal(frame["observation.images.ultrasound"], observed["image"][..., 0])
        state = dict(zip(names["observation.state"], frame["observation.state"], strict=True))
        assert state["contact.contact"] == observed["contact"][0]
        assert [state[f"pose.{part}"] for part in "xyz"] == observed["pose"][:3].tolist()
        assert state["wrench.fz"] == observed["wrench"][2]
        truth = environment.truth
        assert np.array_equal(frame["truth.labels"], truth.labels)
        assert frame["truth.pose"][:3] == pytest.approx(truth.pose.position)
        assert frame["truth.wrench"] == pytest.approx(truth.wrench, rel=1e-6, abs=1e-12)
        areas = dict(zip(names["truth.areas"], frame["truth.areas"], strict=True))
        vein = (truth.labels == 6).sum() * environment.simulation.pixel_area
        assert areas["vein"] == pytest.approx(vein)
        observed, reward, done, *_ = environment.step(frame["action"])
        assert frame["next.reward"] == pytest.approx(reward)
        assert (frame["next.success"], frame["next.done"]) == (done, number == STEPS)
    assert number == STEPS


class Handed:
    """Stands in for LeRobotDataset and keeps what it is handed."""

    made: "Handed"

    @classmethod
    def create(cls, _, rate, features, root, **told):
        cls.made = self = cls()
        root.mkdir(parents=True)
        self.rate, self.features, self.told = rate, features, told
        self.frames, self.ends = [], []
        return self

    def add_frame(self, frame):
        self.frames.append(frame)

    def save_episode(self):
        self.ends.append(len(self.frames))

    def finalize(self):
        self.ends.append("end")


@pytest.fixture
def handed(monkeypatch):
    for name in ("lerobot", "lerobot.datasets", "lerobot.datasets.lerobot_dataset", "datasets"):
        module = ModuleType(name)
        module.__spec__ = sys.__spec__  # of some module: it is there
        monkeypatch.setitem(sys.modules, name, module)
    module.disable_progress_bars = lambda: None
    monkeypatch.setattr(
        sys.modules["lerobot.datasets.lerobot_dataset"], "LeRobotDataset", Handed, raising=False
    )
    return Handed


def test_lerobot_is_handed_features_frames_and_ends(made, tmp_path, handed):
    given = [(name, *episode(made, name)) for name in ("00-short-000000", "00-short-000001")]
    episodes = [LeRobotEpisode(frames, names, "find it", name) for name, _, frames, names in given]
    write_episodes(tmp_path / "data", 30, episodes, is_video=True)
    given = handed.made
    assert (tmp_path / "data").is_dir()
    assert (given.rate, given.ends) == (30, [STEPS, 2 * STEPS, "end"])
    image = given.features["observation.images.ultrasound"]
    assert image == {
        "dtype": "video",
        "shape": (80, 96, 3),
        "names": ["height", "width", "channels"],
    }
    for frame in given.frames:
        assert frame.pop("task") == "find it"
        assert {k: (v.dtype.name, v.shape) for k, v in frame.items() if k not in image} | {
            "observation.images.ultrasound": ("video", (80, 96, 3))
        } == {k: (f["dtype"], f["shape"]) for k, f in given.features.items()}
    assert given.features["action"]["names"] == ["x", "y", "z", "rx", "ry", "rz"]


def test_what_fails_leaves_no_folder(tmp_path, handed, monkeypatch):
    def full(_):
        raise OSError("no space")

    monkeypatch.setattr(handed, "save_episode", full)
    frame = {"observation.state": np.zeros(2, np.float32)}
    with pytest.raises(EpisodeError, match="cannot be written: no space"):
        write_episodes(tmp_path / "data", 30, [LeRobotEpisode([frame], {}, "", "a")])
    assert list(tmp_path.iterdir()) == []


def test_an_episode_unlike_the_first_and_a_folder_that_is_there_are_refused(tmp_path, handed):
    del handed
    frame = {"observation.state": np.zeros(2, np.float32)}
    episodes = [
        LeRobotEpisode([frame], {"observation.state": names}, "", name)
        for names, name in ((["x", "y"], "a"), (["z", "y"], "b"))
    ]
    with pytest.raises(EpisodeError, match=r"b: observation\.state is .*'z'"):
        write_episodes(tmp_path / "data", 30, episodes)
    (tmp_path / "data").mkdir()
    with pytest.raises(EpisodeError, match="exists already"):
        write_episodes(tmp_path / "data", 30, episodes)


def test_a_missing_lerobot_and_a_rate_that_is_none_are_told_before_work(
    scene, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert main(["dataset", scene, "--out", str(tmp_path / "set"), "--format", "lerobot"]) == 1
    assert "pip install 'lerobot[dataset]>=0.4'" in capsys.readouterr().err
    assert not (tmp_path / "set").exists()
    monkeypatch.undo()
    monkeypatch.setattr("us_sim.recording.lerobot_writer.require_lerobot", lambda: None)
    given = yaml.safe_load(Path(scene).read_text())
    given["episode"]["period"] = "20 ms"
    (tmp_path / "faster.yaml").write_text(yaml.safe_dump(given))
    scenes = [scene, str(tmp_path / "faster.yaml")]
    assert main(["dataset", *scenes, "--out", str(tmp_path / "set"), "--format", "lerobot"]) == 1
    assert "scenes have [30, 50] steps a second" in capsys.readouterr().err
    assert not (tmp_path / "set").exists()
    assert compute_frame_rate(1 / 30) == 30
    with pytest.raises(EpisodeError, match=r"makes 33\.3333 steps a second.*set it to"):
        compute_frame_rate(0.03)


def test_lerobot_itself_loads_the_same_for_any_number_of_workers(scene, made, tmp_path, capsys):
    pytest.importorskip("lerobot", reason="lerobot is not installed: it brings torch")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    command = ["dataset", scene, "--episodes", "2", "--task", "FindVein", "--format", "lerobot"]
    assert main([*command, "--out", str(made)]) == 0
    assert main([*command, "--out", str(tmp_path / "two"), "--workers", "2"]) == 0
    one, two = (LeRobotDataset("a/b", root=out / "lerobot") for out in (made, tmp_path / "two"))
    assert (one.num_episodes, one.num_frames, one.fps) == (2, 2 * STEPS, 30)
    _, frames, _ = episode(made)
    for k, frame in enumerate(frames, STEPS):
        item, other = one[k], two[k]
        image = (255 * item["observation.images.ultrasound"].numpy()).round()
        assert (image == frame["observation.images.ultrasound"]).all()  # PNG loses nothing
        for name in ("observation.state", "action", "truth.labels", "next.reward"):
            assert np.array_equal(item[name].numpy().reshape(frame[name].shape), frame[name])
        assert all(str(item[name]) == str(other[name]) for name in item)
    assert item["task"] == "Bring the vein to the image's middle, in contact and not pressed flat."
    (made / "lerobot" / "meta" / "info.json").write_text('{"total_episodes": 1}')
    assert main([*command, "--out", str(made)]) == 1
    assert "has 1 episodes of 2: remove the folder" in capsys.readouterr().err
