"""Limits of the page, of a table that is known beforehand."""

import pandas as pd

from us_sim.evaluation.viewer.report import report_viewer

WHO = ("viewer", "browser")


def test_what_is_asked_is_compared_with_the_run_without_a_viewer():
    shown = {"images_a_second_shown": 26.0, "delay_ms_median": 40.0, "delay_ms_p99": 130.0}
    columns = ["case", "images_a_second_made", *shown, "start_s", "page_opened_s"]
    columns += [f"{of}_{who}" for of in ("cores", "growth_mb_a_minute") for who in WHO]
    rows = [
        {"case": "no viewer, path", "images_a_second_made": 60.0},
        {"case": "1 browser, path", "images_a_second_made": 51.0},
        {"case": "1 browser, hand", **shown},
    ]
    table = pd.DataFrame(rows, columns=columns).assign(seconds=8.0)
    seen = {
        target.quantity: (target.measured, target.met) for target in report_viewer(table).targets
    }
    assert seen["images a second that the simulator loses to a page"] == ("15 %", False)
    assert seen["images a second in a browser, hand"] == ("26", True)
    assert seen["browser: likewise, 99th percentile"] == ("130 ms", False)
    assert seen["s from opening a page to its image"] == ("not measured", None)
