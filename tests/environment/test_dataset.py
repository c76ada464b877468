"""A data set is the same for any number of workers, and goes on where it stopped."""

import hashlib
import io
import json
import resource
import socket
import subprocess
import sys
import tarfile
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from us_sim.command.main import main
from us_sim.environment import dataset
from us_sim.environment.agents import WanderingAgent
from us_sim.environment.environment import ScanEnvironment

STEPS = 6
WITHOUT_RAY = "the extra `ray` is not installed"


@pytest.fixture(scope="module")
def scene(small_scene, tmp_path_factory):
    file = tmp_path_factory.mktemp("scene") / "short.yaml"
    given = {"based_on": str(small_scene), "name": "short", "skin": None}
    given["episode"] = {"steps": STEPS, "draws": {"height": [0.0, 0.0]}}
    file.write_text(yaml.safe_dump(given))
    return str(file)


def make(scene, out, *options):
    return main(["dataset", scene, "--episodes", "3", "--out", str(out), *options])


@pytest.fixture(scope="module")
def made(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("data") / "set"
    assert make(scene, out, "--task", "FindVein") == 0
    return out


def digests(folder):
    return {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in sorted(folder.iterdir())}


def steps_of(shard):
    """The members of each step, as any reader of a WebDataset groups them."""
    steps: dict[str, dict[str, bytes]] = {}
    with tarfile.open(shard) as tar:
        for member in tar:
            key, _, ending = member.name.partition(".")
            steps.setdefault(key, {})[ending] = tar.extractfile(member).read()
    return list(steps.values())


@pytest.mark.slow
def test_workers_change_no_byte(scene, made, tmp_path):
    assert make(scene, tmp_path / "set", "--task", "FindVein", "--workers", "2") == 0
    assert digests(tmp_path / "set") == digests(made)


def test_a_shard_holds_what_the_environment_gives(scene, made):
    facts = json.loads((made / "00-short-000001.json").read_text())
    steps = steps_of(made / "00-short-000001.tar")
    assert len(steps) == facts["images"] == STEPS
    environment = ScanEnvironment("FindVein", scene)
    environment.reset(seed=facts["seed"])
    for step in steps:
        state, told = environment.truth, json.loads(step["json"])
        for name, truth in (("image.png", state.image), ("labels.png", state.labels)):
            coded = np.frombuffer(step[name], np.uint8)
            assert np.array_equal(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), truth)
        moved = 1e-6 * np.load(io.BytesIO(step["displacement.npy"]))
        assert np.abs(moved - state.displacement).max() <= 0.51e-6  # m: of a rounded µm
        assert told["wrench"] == state.wrench.tolist()
        vein = (state.labels == 6).sum() * environment.simulation.pixel_area
        assert told["areas"]["vein"] == pytest.approx(vein)
        _, reward, *_ = environment.step(told["action"])
        assert told["reward"] == reward


def test_the_same_command_makes_only_what_is_missing(scene, made, monkeypatch, capsys):
    before = digests(made)
    (made / "00-short-000002.tar").unlink()
    seen = []
    record = dataset._record_shard
    monkeypatch.setattr(dataset, "_record_shard", lambda *args: seen.append(args) or record(*args))
    assert make(scene, made, "--task", "FindVein") == 0
    assert [order.name for order, _ in seen] == ["00-short-000002"]
    assert digests(made) == before
    assert "18 images in 3 episodes, 0 of them with the task done" in capsys.readouterr().out
    assert json.loads((made / "manifest.json").read_text())["successes"] == 0


def test_another_data_set_or_folder_is_refused(scene, made, tmp_path, capsys):
    assert make(scene, made, "--task", "FindVein", "--seed", "1") == 1
    assert "holds a data set of other seed; choose another folder" in capsys.readouterr().err
    (tmp_path / "mine.txt").write_text("mine")
    assert make(scene, tmp_path) == 1
    assert "is not empty; choose another folder" in capsys.readouterr().err


def test_an_episode_that_fails_is_told_and_the_others_go_on(scene, tmp_path, monkeypatch, capsys):
    class Stumbles(WanderingAgent):
        def __init__(self, seed):
            super().__init__(seed)
            if seed == json.loads((tmp_path / "seed").read_text()):
                raise FloatingPointError("stumbled")

    out = tmp_path / "set"
    (tmp_path / "seed").write_text(str(np.random.SeedSequence([0, 0, 1]).generate_state(1)[0]))
    monkeypatch.setattr(dataset, "WanderingAgent", Stumbles)
    assert make(scene, out) == 1
    told = json.loads((out / "manifest.json").read_text())["episodes"]
    assert [("error" in each, each.get("images")) for each in told.values()] == [
        (False, STEPS),
        (True, None),
        (False, STEPS),
    ]
    assert "stumbled" in told["00-short-000001"]["error"]
    assert "00-short-000001 failed: FloatingPointError('stumbled')" in capsys.readouterr().out
    assert not (out / "00-short-000001.tar").exists()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_workers_end_with_the_process_that_is_killed(scene, tmp_path):
    words = "dataset", scene, "--episodes", "500", "--out", str(tmp_path / "set"), "--workers", "2"
    process = subprocess.Popen([sys.executable, "-m", "us_sim", *words])
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    while not list(tmp_path.glob("set/*.tar")):
        assert process.poll() is None
        time.sleep(0.1)
    begun = [Path("/proc", number) for number in children.read_text().split()]
    process.kill()
    process.wait()
    end = time.monotonic() + 10.0
    while any(child.exists() for child in begun):
        assert time.monotonic() < end
        time.sleep(0.1)
    assert len(begun) >= 2


@pytest.mark.slow
def test_a_full_disk_is_one_sentence_and_the_command_goes_on_later(scene, tmp_path, capsys):
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, limit[1]))  # of a file, as a disk's end
    try:
        assert make(scene, tmp_path / "set") == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    said = capsys.readouterr().err
    assert "cannot be written: File too large; make room and give the same command again" in said
    assert not list((tmp_path / "set").glob("*.tar"))
    assert make(scene, tmp_path / "set") == 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--task", "FindVien"], "--task: 'FindVien' is not one of"),
        (["--episodes", "0"], "--episodes: 0 is outside 1 to"),
        (["--set", "tissue.solver"], "--set tissue.solver: write KEY=VALUE"),
        (["--set", "tissue.solver=fme"], "tissue.solver: 'fme' is not one of"),
    ],
)
def test_options_that_make_no_sense_are_refused(scene, tmp_path, capsys, options, said):
    try:
        status = main(["dataset", scene, "--out", str(tmp_path / "set"), *options])
    except SystemExit as ended:
        status = ended.code
    assert status
    assert said in capsys.readouterr().err
    assert not (tmp_path / "set").exists()


@pytest.fixture
def cluster(monkeypatch):
    cluster_utils = pytest.importorskip("ray.cluster_utils", reason=WITHOUT_RAY)
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    cluster = cluster_utils.Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    yield cluster
    cluster.shutdown()


def test_a_node_that_is_killed_loses_and_doubles_nothing(cluster, scene, tmp_path, monkeypatch):
    node, shown = cluster.add_node(num_cpus=1), []

    class Killing(dataset.ProgressBar):
        """Kills a node after the first episode, when both have been given others."""

        def update(self, done, text=""):
            shown.append(done)
            if done == 1:
                cluster.remove_node(node, allow_graceful=False)
            super().update(done, text)

    options = "--task", "FindVein", "--episodes", "6"
    with monkeypatch.context() as patched:
        patched.setattr(dataset, "ProgressBar", Killing)
        assert make(scene, tmp_path / "ray", *options, "--ray", cluster.address) == 0
    assert shown == list(range(7))
    assert not cluster.worker_nodes
    assert make(scene, tmp_path / "one", *options) == 0
    assert digests(tmp_path / "ray") == digests(tmp_path / "one")


@pytest.mark.slow
def test_an_address_of_fsspec_holds_the_same_bytes(scene, made, tmp_path):
    upath = pytest.importorskip("upath", reason=WITHOUT_RAY)
    there = upath.UPath("memory://dataset/set")
    for _ in range(2):  # the second time it is all there
        assert make(scene, there, "--task", "FindVein") == 0
    held = {file.name: file.read_bytes() for file in there.iterdir()}
    assert held == {file.name: file.read_bytes() for file in made.iterdir()}
    assert make(scene, (tmp_path / "set").as_uri(), "--task", "FindVein") == 0
    assert digests(tmp_path / "set") == digests(made)


def nobody_listens():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{free.getsockname()[1]}"


@pytest.mark.parametrize(
    ("package", "out", "options", "said"),
    [
        ("ray", "set", ["--ray", nobody_listens()], "no cluster can be used there: [Errno 111]"),
        ("upath", "nowhere://set", [], "--out nowhere://set: cannot be used: Unsupported"),
        ("upath", "memory://set", ["--workers", "2"], "each process has its own"),
    ],
)
def test_addresses_that_lead_nowhere_are_one_sentence(
    package, out, options, said, scene, tmp_path, monkeypatch, capsys
):
    pytest.importorskip(package, reason=WITHOUT_RAY)
    monkeypatch.chdir(tmp_path)
    assert make(scene, out, *options) == 1
    assert said in capsys.readouterr().err
