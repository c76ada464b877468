"""Data sets: episodes with images and every truth.

The bytes are the same for any number of processes, on one machine or on many. Each episode is one
shard of a WebDataset (https://github.com/webdataset/webdataset): a tar file whose members of one
step have one name. Beside it lies a JSON file of its draws. Whole episodes are not made again, so
an interrupted command goes on when repeated.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import multiprocessing.connection
import os
import shutil
import signal
import socket
import tarfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim import __version__
from us_sim.environment.agents import VisualServo, WanderingAgent
from us_sim.environment.environment import ScanEnvironment, resolve_scene
from us_sim.environment.tasks import TASKS
from us_sim.errors import EpisodeError, UsSimError
from us_sim.progress import ProgressBar
from us_sim.recording.attached_files import list_versions
from us_sim.scene.scene import Scene
from us_sim.settings.quantity import Quantity
from us_sim.settings.reading import dump_settings
from us_sim.settings.setting import Settings, setting
from us_sim.settings.spelling import format_count
from us_sim.volume.partial_file import partial_file

_COMPUTING = ("python", "us_sim_code", "numpy", "scipy", "numba", "opencv-python-headless")
_CARD = Path(__file__).with_name("data_card.md")
_WITHOUT_TASK = "HoldContact"
"""Task whose environment moves the probe if none is asked for; no reward is recorded then."""
_FORMATS = {"webdataset": None, "lerobot": False, "lerobot-video": True}
"""For LeRobot's formats: true if images are coded as a video."""


@dataclass(frozen=True)
class DatasetSettings(Settings):
    """A data set."""

    error = EpisodeError

    out: str = setting(description="folder, or an address of fsspec")
    episodes: int = setting(
        Quantity("number", 1, 10_000_000), "number of episodes of each scene", default=10
    )
    task: str | None = setting(
        description="record its rewards too, and have an agent do it that sees the image alone "
        "where there is one (FindVein, CompressVein); else the probe wanders over the skin",
        choices=tuple(TASKS),
        default=None,
    )
    workers: int = setting(Quantity("number", 1, 1024), "number of processes", default=1)
    ray: str | None = setting(description="address of a Ray cluster, or local", default=None)
    seed: int = setting(Quantity("number", 0, 2**31), "decides every byte", default=0)
    format: str = setting(
        description="of the data set; the last two are written from the first, into its folder, "
        "with images as PNG or as MP4",
        choices=tuple(_FORMATS),
        default="webdataset",
    )


@dataclass(frozen=True)
class _EpisodeOrder:
    """An episode to be made."""

    scene: Scene
    scene_name: str  # as it was asked for
    task: str | None
    seed: int
    name: str  # of the shard, without its ending
    out: Path  # or a UPath, for files that are not on this machine

    @property
    def shard_path(self) -> Path:
        return self.out / f"{self.name}.tar"

    @property
    def facts_path(self) -> Path:
        return self.out / f"{self.name}.json"

    def read_facts(self) -> dict[str, Any] | None:
        """Read the facts of the episode; None unless it is there whole."""
        with contextlib.suppress(OSError, ValueError):
            facts: dict[str, Any] = json.loads(self.facts_path.read_text(encoding="utf-8"))
            if self.shard_path.is_file():
                return facts
        return None


def make_dataset(
    scenes: Sequence[str], settings: DatasetSettings, changes: Mapping[str, Any] | None = None
) -> int:
    """Make the missing episodes of a data set; return 1 if an episode failed, else 0.

    Args:
        scenes: names or files.
        settings: of the data set.
        changes: keys of the scenes, in place of their own.

    Raises:
        UsSimError: a scene cannot be used, the folder holds another data set, a file cannot be
            written, or a process was ended.
    """
    out = _open_folder(settings)
    loaded = [resolve_scene(scene, settings=changes) for scene in scenes]
    _require_format(loaded, out, settings)
    description = _describe_dataset(scenes, loaded, settings)
    _require_same(out, description)
    orders = list(_plan_episodes(scenes, loaded, settings, out))
    found = {order.name: order.read_facts() for order in orders}
    missing = [order for order in orders if found[order.name] is None]
    # In this process first, where kernels are compiled and a volume is made with progress.
    for order in {order.scene_name: order for order in missing}.values():
        _load_environment(order)
    try:
        with ProgressBar("making", len(orders), "episodes") as bar:
            bar.update(len(orders) - len(missing))
            for order, facts in _make_episodes(missing, settings):
                found[order.name] = facts
                bar.update(sum(each is not None for each in found.values()))
    finally:
        for begun in out.glob(".*.partial-*") if isinstance(out, Path) else ():
            shutil.rmtree(begun, ignore_errors=True)  # by processes that were killed
    made = {name: facts for name, facts in found.items() if facts is not None}
    failed = {name: facts["error"] for name, facts in made.items() if "error" in facts}
    images = format_count(sum(int(facts.get("images", 0)) for facts in made.values()), "image")
    amount, successes = f"{images} in {format_count(len(made) - len(failed), 'episode')}", {}
    if settings.task:
        successes["successes"] = sum(facts.get("is_success", False) for facts in made.values())
        amount += f", {successes['successes']} of them with the task done"
    _write(out / "manifest.json", _encode_json({**description, **successes, "episodes": made}))
    card = _CARD.read_text(encoding="utf-8").format(
        amount=amount,
        scenes=", ".join(scenes),
        task=settings.task or "none: the probe wanders over the skin",
        seed=settings.seed,
        version=__version__,
    )
    _write(out / "README.md", card.encode())
    print(f"{amount}, in {settings.out}")
    for name, error in failed.items():
        print(f"{name} failed: {error}")
    is_video, whole = _FORMATS[settings.format], {n: made[n] for n in made.keys() - failed}
    if is_video is not None and whole:
        from us_sim.environment.lerobot_episodes import convert_shards

        folder, period = out / settings.format, loaded[0].episode.period
        convert_shards(folder, out, whole, settings.task, period, is_video=is_video)
        print(folder)
    return int(bool(failed))


def _require_format(scenes: Sequence[Scene], out: Path, settings: DatasetSettings) -> None:
    """Refuse scenes and folders that the format does not allow, before anything is made.

    Raises:
        EpisodeError: the format is LeRobot's, and it is not installed, the folder is not on this
            machine, or the scenes have several periods, or one that it cannot have.
    """
    if _FORMATS[settings.format] is None:
        return
    from us_sim.environment.lerobot_episodes import compute_frame_rate
    from us_sim.recording.lerobot_writer import require_lerobot

    require_lerobot()
    if not isinstance(out, Path):
        raise EpisodeError(f"--out {settings.out}: {settings.format} needs a folder, no address")
    rates = {compute_frame_rate(scene.episode.period) for scene in scenes}
    if len(rates) > 1:
        raise EpisodeError(
            f"scenes have {sorted(rates)} steps a second, and a LeRobot data set one rate: make a "
            f"data set of each"
        )


def _plan_episodes(
    names: Sequence[str], scenes: Sequence[Scene], settings: DatasetSettings, out: Path
) -> Iterator[_EpisodeOrder]:
    for k, (name, scene) in enumerate(zip(names, scenes, strict=True)):
        for n in range(settings.episodes):
            words = np.random.SeedSequence([settings.seed, k, n]).generate_state(1)
            shard = f"{k:02d}-{scene.name.replace('/', '_')}-{n:06d}"
            yield _EpisodeOrder(scene, name, settings.task, int(words[0]), shard, out)


_Submit = Callable[[_EpisodeOrder], "Future[dict[str, Any]]"]


def _make_episodes(
    orders: Sequence[_EpisodeOrder], settings: DatasetSettings
) -> Iterator[tuple[_EpisodeOrder, dict[str, Any]]]:
    """Make the episodes; yield each with its facts, as it is finished."""
    workers = min(settings.workers, len(orders))
    if len(orders) <= 1 or (workers == 1 and settings.ray is None):
        yield from ((order, _make_episode(order)) for order in orders)
        return
    with _start_ray(settings.ray) if settings.ray else _start_processes(workers) as submit:
        waiting = {submit(order): order for order in orders}
        for future in as_completed(waiting):
            yield waiting[future], future.result()


@contextlib.contextmanager
def _start_processes(workers: int) -> Iterator[_Submit]:
    context = multiprocessing.get_context("spawn")  # numba and threads are here already
    with ProcessPoolExecutor(workers, context, _begin_worker) as pool:
        try:
            yield lambda order: pool.submit(_make_episode, order)
        except BrokenProcessPool as error:
            raise EpisodeError(
                "a process that makes episodes was ended, as for want of memory: give the same "
                "command again with fewer --workers; the episodes made so far are kept"
            ) from error
        finally:
            pool.shutdown(cancel_futures=True)


def _begin_worker() -> None:
    """Ignore Ctrl-C, and end with the process that makes the data set."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    multiprocessing.connection.wait([parent.sentinel])
    os._exit(1)


@contextlib.contextmanager
def _start_ray(address: str) -> Iterator[_Submit]:
    """Connect to a Ray cluster, which makes an episode again if its worker or node is lost.

    Raises:
        EpisodeError: Ray is not installed, there is no such cluster, or it has lost an episode
            several times.
    """
    try:
        import ray
    except ModuleNotFoundError as error:
        raise EpisodeError("--ray needs the package ray: pip install 'us_sim[ray]'") from error
    # A cluster that is started here would report its use to Ray's makers.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        if ":" in address:  # where nobody listens, Ray would try for minutes
            host, _, port = address.removeprefix("ray://").rpartition(":")
            socket.create_connection((host, int(port)), timeout=5.0).close()
        ray.init(address, log_to_driver=False, logging_level=logging.CRITICAL)
    except (OSError, ValueError, RuntimeError) as error:
        raise EpisodeError(
            f"--ray {address}: no cluster can be used there: {error}; `ray start --head` starts "
            f"one, and --ray local one for this command alone"
        ) from error
    try:
        make = ray.remote(_make_episode)
        yield lambda order: make.remote(order).future()
    except ray.exceptions.RayTaskError as error:
        raise error.cause from error
    except ray.exceptions.RayError as error:
        raise EpisodeError(
            f"--ray {address}: {error}; give the same command again, the episodes made so far are "
            f"kept"
        ) from error
    finally:
        ray.shutdown()


_environments: dict[tuple[str, str | None], ScanEnvironment] = {}


def _load_environment(order: _EpisodeOrder) -> ScanEnvironment:
    """Return this process' environment for an order's scene and task."""
    key = order.scene_name, order.task
    if key not in _environments:
        cv2.setNumThreads(1)
        made = ScanEnvironment(order.task or _WITHOUT_TASK, order.scene)
        _environments.clear()  # one at a time: its volume and its tissue are large
        _environments[key] = made
    return _environments[key]


def _make_episode(order: _EpisodeOrder) -> dict[str, Any]:
    """Make an episode and its files; if it fails, write no shard, and the error in its facts.

    Raises:
        EpisodeError: a file cannot be written.
    """
    facts: dict[str, Any] = {"seed": order.seed}
    try:
        with _open_whole_file(order.shard_path, _FullError) as path:
            facts |= _record_shard(order, path)
    except _FullError as error:
        raise EpisodeError(
            f"{error}; make room and give the same command again, the episodes made so far are kept"
        ) from error
    except Exception as error:  # a solver's own, say: the other episodes go on
        facts["error"] = str(error) if isinstance(error, UsSimError) else repr(error)
    _write(order.facts_path, _encode_json(facts))
    return facts


class _FullError(UsSimError):
    """Error of a shard that cannot be written, as on a full disk."""


def _record_shard(order: _EpisodeOrder, path: Path) -> dict[str, Any]:
    environment = _load_environment(order)
    observation, info = environment.reset(seed=order.seed)
    draw, images, is_success = info["draw"], 0, False
    agent: Any = WanderingAgent(order.seed)
    if order.task in ("FindVein", "CompressVein"):
        agent = VisualServo(press=order.task == "CompressVein")
    labels = environment.simulation.volume.label_names
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as shard:
        while True:
            action = environment.translate_twist(agent.act(observation))
            members = _collect_members(environment, observation, labels)
            observation, reward, done, truncated, info = environment.step(action)
            step = members.pop("json") | {"action": action.tolist()}
            if order.task:
                truths = environment.task.collect_facts()
                known = {name: truth for name, truth in truths.items() if not np.isnan(truth)}
                step |= {"reward": reward, "is_success": done, **known}
                is_success = is_success or done
            members["json"] = _encode_json(step)
            for ending, content in members.items():
                entry = tarfile.TarInfo(f"{order.name}_{images:05d}.{ending}")
                entry.size = len(content)
                shard.addfile(entry, io.BytesIO(content))
            images += 1
            if done or truncated:
                break
    facts = {"scene": order.scene_name, "images": images, "draw": draw, "labels": labels}
    return facts | ({"is_success": is_success} if order.task else {})


def _collect_members(
    environment: ScanEnvironment, observation: Mapping[str, NDArray[Any]], labels: Mapping[int, str]
) -> dict[str, Any]:
    """Collect the files of a step by their endings; ``json`` is still a mapping."""
    state, area = environment.truth, environment.simulation.pixel_area
    members: dict[str, Any] = {"image.png": _encode_png(state.image)}
    step: dict[str, Any] = {
        "pose": [*state.pose.position.tolist(), *state.pose.orientation.tolist()],
        "wrench": state.wrench.tolist(),
        "is_balanced": state.is_balanced,
        "contact": state.contact,
        "observed": {
            name: value.tolist() for name, value in observation.items() if value.ndim == 1
        },
    }
    if labels:
        members["labels.png"] = _encode_png(state.labels)
        counts = np.bincount(state.labels.ravel(), minlength=256)
        step["areas"] = {name: float(area * counts[n]) for n, name in labels.items()}
    if environment.scene.tissue is not None:
        members["displacement.npy"] = _encode_npy(state.displacement, 1e-6)
        if "strain" in environment.scene.episode.observe:
            members["strain.npy"] = _encode_npy(state.strain, 1e-4)
    return members | {"json": step}


def _encode_png(image: NDArray[np.uint8]) -> bytes:
    how = cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE
    _, content = cv2.imencode(".png", image, how)
    return content.tobytes()


def _encode_npy(array: NDArray[np.float32], unit: float) -> bytes:
    """Encode an array as int16 multiples of a unit: few bytes, and no subnormals."""
    stream = io.BytesIO()
    np.save(stream, np.rint(array / unit).clip(-32768, 32767).astype(np.int16))
    return stream.getvalue()


def _describe_dataset(
    names: Sequence[str], scenes: Sequence[Scene], settings: DatasetSettings
) -> dict[str, Any]:
    """Return all that decides the bytes, as JSON reads it back."""
    lines = (line.rpartition(" ") for line in list_versions().splitlines())
    found = {name: version for name, _, version in lines if name in _COMPUTING}
    described = {
        "seed": settings.seed,
        "task": settings.task,
        "episodes_of_each_scene": settings.episodes,
        "scenes": {name: dump_settings(scene) for name, scene in zip(names, scenes, strict=True)},
        "versions": {"us_sim": __version__, **found},
    }
    read_back: dict[str, Any] = json.loads(_encode_json(described))
    return read_back


def _require_same(out: Path, description: Mapping[str, Any]) -> None:
    """Begin a data set in a folder, or make sure that it holds the same one.

    Raises:
        EpisodeError: it holds another, or something else.
    """
    manifest = out / "manifest.json"
    try:
        out.mkdir(parents=True, exist_ok=True)
        if not manifest.exists():
            if out.exists() and any(out.iterdir()):  # a store of objects has no empty folders
                raise EpisodeError(f"--out {out}: is not empty; choose another folder")
            _write(manifest, _encode_json({**description, "episodes": {}}))
            return
        found = json.loads(manifest.read_text(encoding="utf-8"))
    except ValueError:
        found = {}
    except UsSimError:
        raise
    except Exception as error:  # each kind of address has its own
        problem = getattr(error, "strerror", None) or error
        raise EpisodeError(f"--out {out}: cannot be used: {problem}") from error
    found = found if isinstance(found, dict) else {}
    other = [key for key, value in description.items() if found.get(key) != value]
    if other:
        raise EpisodeError(
            f"--out {out}: holds a data set of other {', '.join(other)}; choose another folder"
        )


def _encode_json(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=1, sort_keys=True) + "\n").encode()


def _open_folder(settings: DatasetSettings) -> Path:
    """Open the folder of a data set; a UPath if it is an address of fsspec.

    Raises:
        EpisodeError: the address cannot be used.
    """
    address = settings.out.removeprefix("file://")
    if "://" not in address:
        return Path(address).absolute()  # nodes of a cluster work in other folders
    try:
        from upath import UPath

        folder: Any = UPath(address)
        _ = folder.fs  # asks for the packages of its kind
    except ModuleNotFoundError as error:
        raise EpisodeError(
            f"--out {address}: needs the package universal_pathlib: pip install 'us_sim[ray]'"
        ) from error
    except (ImportError, ValueError) as error:
        raise EpisodeError(f"--out {address}: cannot be used: {error}") from error
    if folder.protocol == "memory" and (settings.ray or settings.workers > 1):
        raise EpisodeError(f"--out {address}: each process has its own; give another address")
    return folder


@contextlib.contextmanager
def _open_whole_file(path: Any, error_type: type[UsSimError] = EpisodeError) -> Iterator[Path]:
    """Open a file of this machine, which comes to ``path`` at the end, whole or not at all."""
    is_local = isinstance(path, Path)
    with contextlib.ExitStack() as stack:
        local = path if is_local else Path(stack.enter_context(TemporaryDirectory()), path.name)
        with partial_file(local, error_type=error_type) as partial:
            yield partial
        if not is_local:
            try:
                path.fs.put_file(str(local), path.path)
            except Exception as error:  # each kind of address has its own
                raise error_type(f"{path}: cannot be written: {error}") from error


def _write(path: Path, content: bytes) -> None:
    with _open_whole_file(path) as partial:
        partial.write_bytes(content)
