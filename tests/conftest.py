"""How the whole suite runs, and fixtures shared by all tests."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from chromium import chromium
from hypothesis import settings

import us_sim

settings.register_profile("busy machine", deadline=None, max_examples=50)
settings.load_profile("busy machine")

# Programs that tests start import the package from where it is tested, and not from the folder that
# they are in: kernels are kept for each place, and would all be compiled a second time.
_PLACE = str(Path(us_sim.__file__).parents[1])
_SEARCHED = os.environ.get("PYTHONPATH", "").split(os.pathsep)
os.environ["PYTHONPATH"] = os.pathsep.join(dict.fromkeys([_PLACE, *filter(None, _SEARCHED)]))
os.environ["PYTHONSAFEPATH"] = "1"

_BESIDE_THE_PROJECT = Path(__file__).resolve().parents[2] / "shared" / "data"

_WORKER = "PYTEST_XDIST_WORKER"
_MARKED = "US_SIM_TESTS_MARKED"

_MEASURED = ("hand", "measured", "stability", "test_independent_forces", "tissue")
_TISSUE = ("tissue", *(f"evaluation/{name}" for name in _MEASURED))
"""Tests of the kernels that take longest to compile: one process compiles them, and meanwhile
the other one what is beside them."""

_BESIDE = ("slicing", "evaluation", "tracking", "volume", "skin", "geometry")

_AFTER = ("tracking/test_haptic.py",)
"""Of these, those that use what the first process compiles."""

_RUNNING = ("graph/", "evaluation/latency")
"""Tests of whole graphs: sooner, their processes would compile what others just compile."""

_PLAIN = "smoke or not (graph or browser or data or slow)"
"""What a plain `pytest` runs."""

_BY_GROUPS = pytest.StashKey[bool]()


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Run the quick tests where nothing else was asked for, and all of a mark in two processes."""
    option = config.option
    if _WORKER in os.environ:  # which is given the command's words alone
        option.markexpr = os.environ.get(_MARKED, option.markexpr)
        return
    if config.args_source is not pytest.Config.ArgsSource.TESTPATHS:
        return
    if not (option.keyword or option.markexpr):
        option.markexpr = os.environ[_MARKED] = _PLAIN
    chosen = option.keyword or option.collectonly or option.usepdb or option.capture == "no"
    if (
        not chosen
        and config.pluginmanager.hasplugin("xdist")
        and option.numprocesses is None
        and (os.cpu_count() or 1) > 1
    ):
        config.stash[_BY_GROUPS] = True
        option.numprocesses = 1 + (os.cpu_count() or 1)  # many tests wait for messages
        option.dist = "loadscope"
        option.loadscopereorder = False


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Who gives groups of tests to the processes."""
    if _BY_GROUPS not in config.stash:
        return None
    from xdist.scheduler import LoadScopeScheduling

    class Groups(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return _group(nodeid)

        def remove_node(self, node: Any) -> str | None:
            """Hand on what a process that crashed has not done, but for what it crashed with.

            xdist 3.8 hands on what was done, too: a process that gets only that waits for ever.
            """
            units = self.assigned_work.pop(node)
            left = [
                test for unit in units.values() for test, is_done in unit.items() if not is_done
            ]
            for scope, unit in units.items():
                open_tests = {test: False for test in unit if test in left[1:]}
                if open_tests:
                    self.workqueue[scope] = open_tests
            for other in self.assigned_work:
                self._reschedule(other)
            return left[0] if left else None

        def _reschedule(self, node: Any) -> None:
            """Give a process work until two tests wait: it begins one when it knows the next."""
            if node not in self.registered_collections:  # it has just been started
                return
            super()._reschedule(node)
            while not node.shutting_down and self._pending_of(self.assigned_work[node]) < 2:
                super()._reschedule(node)

    return Groups(config, log)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests; those that compile most come first, and a process gets a whole group."""
    for item in items:
        if _file(item.nodeid).startswith(_RUNNING):
            item.add_marker("graph")
        names = getattr(item, "fixturenames", ())
        if "browser" in names:
            item.add_marker("browser")
        if "shared_data" in names:
            item.add_marker("data")
    if _WORKER in os.environ:
        items.sort(key=lambda item: _turn(item.nodeid))


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Tell of a failure when it happens: a run of many minutes may be broken off."""
    if report.failed and _WORKER not in os.environ:
        crash = getattr(report.longrepr, "reprcrash", None)
        reason = str(crash.message if crash else report.longrepr).partition("\n")[0]
        print(f"\n{report.nodeid} ({report.when}): {reason[:200]}", flush=True)


def _group(nodeid: str) -> str:
    """The group of a test: its file, or files that share kernels or a machine's time."""
    file = _file(nodeid)
    if file.startswith(_TISSUE):
        return "tissue"
    return "graph" if file.startswith(_RUNNING) else file


def _turn(nodeid: str) -> int:
    file = _file(nodeid)
    if file.startswith(_TISSUE):
        return 0
    if file.startswith(_RUNNING):
        return 2
    return 1 if file.startswith(_BESIDE) and file not in _AFTER else 3


def _file(nodeid: str) -> str:
    return nodeid.partition("::")[0].removeprefix("tests/")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings: US_SIM_TEST_DATA, or shared/data beside the project."""
    folder = Path(os.environ.get("US_SIM_TEST_DATA", _BESIDE_THE_PROJECT))
    if not folder.is_dir():
        pytest.skip(f"no real data: {folder} is not a folder; set US_SIM_TEST_DATA to one")
    return folder


@pytest.fixture(scope="session")
def shared_file(shared_data: Path) -> Callable[[str], Path]:
    """Find a file or folder among the real recordings; without it the test is skipped."""

    def find(name: str) -> Path:
        if not (shared_data / name).exists():
            pytest.skip(f"no {shared_data / name}")
        return shared_data / name

    return find


SMALL_SCENE = Path(__file__).with_name("small_scene.yaml")


@pytest.fixture(scope="session")
def small_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of `small_scene.yaml`, for scenes beside it."""
    file = tmp_path_factory.mktemp("scene") / "small.yaml"
    file.write_text(SMALL_SCENE.read_text())
    return file


@pytest.fixture(scope="session", autouse=True)
def _own_corner() -> None:
    """Keep the tests on this host and out of other simulations' domain."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    worker = os.environ.get(_WORKER, "")
    own = 1 + (os.getppid() if worker else os.getpid()) % 100
    # The workers must not hear each other: the second one is on the next domain.
    domain = int(os.environ.get("ROS_DOMAIN_ID") or own) + int(worker.removeprefix("gw") or 0)
    os.environ["ROS_DOMAIN_ID"] = str(domain)


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """A real Chromium, without a window; a process may have one."""
    with chromium() as started:
        yield started
