"""The cache: made once, whole or absent, shared by processes, mended when damaged."""

import logging
import multiprocessing
import os
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from phantom_asker import ask

from us_sim.cache import load_or_create
from us_sim.volume.phantom.phantom import (
    load_or_make_phantom,
    make_upper_arm,
    pack_volume,
    unpack_volume,
)
from us_sim.volume.volume import Volume

COARSE = 2e-3
load_small = partial(load_or_create, "small", pack_volume, unpack_volume)


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    folder = tmp_path / "cache"
    monkeypatch.setenv("US_SIM_CACHE", str(folder))
    return folder


def _small() -> Volume:
    grey = np.arange(210, dtype=np.uint8).reshape(5, 6, 7)
    return Volume(grey, np.diag([1e-3, 1e-3, 2e-3, 1.0]), grey // 50, {1: "skin", 2: "fat"})


def _unused() -> Volume:
    raise AssertionError("made again although it was kept")


@pytest.mark.usefixtures("cache")
def test_a_phantom_comes_back_as_it_was_made():
    said = []
    made = load_or_make_phantom("upper_arm", 1, COARSE, lambda *what: said.append(what))
    fractions = [fraction for fraction, _ in said]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    kept = load_or_make_phantom("upper_arm", 1, COARSE, lambda *_: pytest.fail("was in the cache"))
    fresh = make_upper_arm(1, COARSE)
    for volume in (made, kept):
        np.testing.assert_array_equal(volume.intensities, fresh.intensities)
        np.testing.assert_array_equal(volume.labels, fresh.labels)
        np.testing.assert_array_equal(volume.index_to_patient, fresh.index_to_patient)
        assert volume.label_names == fresh.label_names


def test_what_a_killed_process_left_is_cleared_away_and_kept_arrays_are_not_copied(cache):
    left_over = cache / "small.partial"
    left_over.mkdir(parents=True)
    load_small(_small)
    assert not left_over.exists()
    base = load_small(_unused).labels
    while not isinstance(base, np.memmap):
        base = base.base
    assert Path(base.filename).parent == cache / "small"


@pytest.mark.parametrize(
    "damage",
    [
        lambda entry: os.truncate(entry / "intensities.npy", 300),
        lambda entry: (entry / "labels.npy").unlink(),
    ],
)
def test_a_damaged_entry_is_made_again_with_a_word(cache, caplog, damage):
    load_small(_small)
    damage(cache / "small")
    with caplog.at_level(logging.WARNING):
        mended = load_small(_small)
    assert "is damaged" in caplog.text
    assert "made again" in caplog.text
    np.testing.assert_array_equal(mended.labels, _small().labels)
    np.testing.assert_array_equal(load_small(_unused).labels, _small().labels)


def test_a_cache_that_cannot_be_written_costs_only_a_warning(tmp_path, monkeypatch, caplog):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("US_SIM_CACHE", str(tmp_path / "file" / "cache"))
    with caplog.at_level(logging.WARNING):
        volume = load_small(_small)
    assert "cannot be written" in caplog.text
    np.testing.assert_array_equal(volume.intensities, _small().intensities)


@pytest.mark.slow
def test_processes_that_ask_at_once_make_it_once(cache, tmp_path):
    marks = tmp_path / "marks"
    marks.mkdir()
    spawn = multiprocessing.get_context("spawn")
    start, answers = spawn.Barrier(3), spawn.Queue()
    processes = [
        spawn.Process(target=ask, args=(str(cache), str(marks), start, answers)) for _ in range(3)
    ]
    for process in processes:
        process.start()
    try:
        sums = {answers.get(timeout=60) for _ in processes}
    finally:
        for process in processes:
            process.join(timeout=60)
            process.kill()
    assert len(sums) == 1
    assert len(list(marks.iterdir())) == 1
