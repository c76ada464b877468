"""The engine that measures a subject and writes its report."""

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from us_sim.errors import UsSimError
from us_sim.evaluation import subject as engine
from us_sim.evaluation.figures import draw_image_grid, draw_lines
from us_sim.evaluation.subject import Piece, Report, Subject, Target

PAGE = "Of $count points.\n\n$error\n\n## Table\n\n$table\n\n## Nothing\n\n$nothing\n"


def break_down():
    raise ValueError("no\nway")


def pieces(quick):
    assert quick
    done = [
        Piece(
            {"method": name}, lambda ms=ms: [{"nodes": 65536, "ms": ms, "image": np.ones((2, 2))}]
        )
        for name, ms in (("fem", 1.23456), ("msds", 10.0))
    ]
    return {"toy": [*done, Piece({"method": "broken"}, break_down)]}


def report(table):
    assert table["image"][0].shape == (2, 2)
    return Report(
        ["`fem` is fast."],
        {
            "count": str(len(table)),
            "error": draw_lines(table, "ms", "nodes", "Errors", lines="method", log="xy"),
            "table": table[["method", "ms"]],
            "nothing": "",
        },
        [Target.at_most("ms", 2.0, table["ms"].max(), "ms")],
    )


@pytest.fixture
def toy(tmp_path, monkeypatch):
    monkeypatch.setattr(engine, "__file__", str(tmp_path / "subject.py"))
    (tmp_path / "toy").mkdir()
    (tmp_path / "toy" / "report.md").write_text(PAGE, encoding="utf-8")
    return Subject("toy", "Toys", pieces, report, hidden=["image"])


def test_a_subject_writes_table_picture_and_page_whatever_breaks(toy, tmp_path, capsys):
    out = tmp_path / "out"
    assert toy(out, True) == 1
    assert (out / "toy.csv").read_text(encoding="utf-8").splitlines() == [
        "method,nodes,ms,failure",
        "fem,65536,1.235,",
        "msds,65536,10,",
        "broken,,,ValueError: no way",
    ]
    page = (out / "toy.md").read_text(encoding="utf-8")
    assert page.startswith("# Toys\n\n- `fem` is fast.\n\n`us-sim evaluate toy --quick`, ")
    for part in (
        "| ms | at most 2 ms | 10 ms | no  |",
        "Of 2 points.",
        "![Errors](toy_error.png)",
        "| fem    | 1.23 |",
        "- broken: ValueError: no way",
    ):
        assert part in page
    assert "## Nothing" not in page
    with Image.open(out / "toy_error.png") as picture:
        assert picture.mode == "P"  # for a small file
        colours = np.asarray(picture.convert("RGB")).reshape(-1, 3).astype(int)
    for wanted in ((255, 255, 255), (0x00, 0x72, 0xB2)):  # the paper, and the marks of a line
        assert np.abs(colours - wanted).max(axis=1).min() < 4
    assert "`fem` is fast." in capsys.readouterr().out
    with pytest.raises(UsSimError, match="exists"):
        toy(out, True)
    with pytest.raises(UsSimError, match="written"):
        toy(tmp_path / "toy" / "report.md", True)


def test_figures_show_every_point_and_image():
    table = pd.DataFrame(
        [(scene, method, n, n * 0.1) for scene in "ab" for method in "xy" for n in (1, 2, 3)],
        columns=["scene", "method", "ms", "error"],
    )
    figure = draw_lines(
        *(table, "ms", "error", ""),
        panels="scene",
        lines="method",
        log="xy",
        limits={"a limit": 2.0},
    )
    assert [panel.get_title(loc="left") for panel in figure.axes] == ["a", "b"]
    marked = [line for line in figure.axes[0].lines if line.get_marker() != "None"]
    assert sum(len(line.get_xdata()) for line in marked) == 6
    grid = draw_image_grid({"row": {"one": np.eye(3), "two": np.eye(3)}}, "")
    assert [len(panel.images) for panel in grid.axes[:2]] == [1, 1]
