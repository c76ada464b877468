"""Ticks at absolute times: none in a burst after a hold-up, none after the end."""

import itertools
import threading
import time

from us_sim.nodes.haptic_renderer import PeriodicThread


def run(thread, done):
    thread.start()
    assert done.wait(20.0)
    thread.stop()


def test_a_hold_up_is_skipped_and_not_made_up_for():
    period, ticks, done = 0.005, [], threading.Event()

    def work(now):
        ticks.append(now)
        if len(ticks) == 20:
            time.sleep(20.5 * period)
        if len(ticks) == 60:
            done.set()

    thread = PeriodicThread(1 / period, work)
    run(thread, done)
    assert thread.skipped >= 19
    count, ways = len(ticks), [b - a for a, b in itertools.pairwise(ticks)]
    # On the whole as many periods passed as there were ticks and skipped ones: nothing drifts.
    assert abs((ticks[59] - ticks[0]) * 1e-9 / period - (59 + thread.skipped)) < 3
    assert sum(way < 0.2e9 * period for way in ways) <= 3
    assert 0.0 < thread.jitter < 25 * period
    time.sleep(4 * period)
    assert len(ticks) == count


def test_it_ends_even_if_it_never_began():
    thread = PeriodicThread(100.0, lambda _: None)
    thread.stop()
    assert thread.jitter == 0.0
