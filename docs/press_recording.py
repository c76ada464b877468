"""Films a press in the browser: docs/viewing/press.webp, made with the keys of `us-sim view`.

python docs/press_recording.py [--out FILE.webp] [--width 800] [--rate 12]

Needs the extra `viewer`, playwright, pillow, and a Chromium (US_SIM_TEST_CHROMIUM, or on PATH). One
picture is taken for each step of the probe, when the image that follows it has been drawn, so the
film is as smooth on a slow machine.
"""

from __future__ import annotations

import argparse
import io
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import sync_playwright

LARGEST = 1_300_000
"""Bytes of the film."""
STEPS = ((None, 4), ("s", 40), (None, 6), ("ArrowDown", 8), ("ArrowUp", 8), ("w", 40), (None, 4))
"""Keys, and how often: a touch of S presses 0.3 mm deeper, of W as much less; None waits."""
DRAWN_AFTER_KEY = 3
"""Images after a key until the picture: the tissue has followed then."""
COUNT = """import("/us_sim/assets/events.js").then(({ events }) => {
  window.drawnImages = 0;
  events.on("image-drawn", () => (window.drawnImages += 1));
})"""
AT_REST = """import("/us_sim/assets/scene/stage.js").then(({ stage }) => new Promise((resolve) => {
  const latest = performance.now() + 2000;
  const timer = setInterval(() => {
    if (!stage.pace.isAtRest && performance.now() < latest) return;
    clearInterval(timer);
    resolve();
  }, 5);
}))"""
"""Until the 3D scene is drawn finely, as it is at rest; for a while at most."""
ARGUMENTS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def address_of(process: subprocess.Popen[str], said: Path) -> str:
    """Where the page is, once the simulator has said it in that file."""
    while process.poll() is None:
        found = re.search(r"http://\S+", said.read_text(encoding="utf-8"))
        if found:
            return found[0]
        time.sleep(0.2)
    raise SystemExit(f"us-sim view ended:\n{said.read_text(encoding='utf-8')}")


def pictures(page: Any) -> Iterator[Image.Image]:
    """The page after each step."""
    page.evaluate(COUNT)
    for _ in range(60):  # until all nodes are there and the hand holds the probe
        page.keyboard.press("h")
        page.wait_for_timeout(1000)
        if page.evaluate("window.drawnImages") > DRAWN_AFTER_KEY:
            break
    for key, times in STEPS:
        for _ in range(times):
            if key is not None:
                page.keyboard.press(key)
            awaited = page.evaluate("window.drawnImages") + DRAWN_AFTER_KEY
            page.wait_for_function("n => window.drawnImages >= n", arg=awaited, timeout=60_000)
            page.evaluate(AT_REST)
            yield Image.open(io.BytesIO(page.screenshot())).convert("RGB")


def film(frames: list[Image.Image], milliseconds: int) -> bytes:
    """A WebP that goes round, as good as it may be without being too large."""
    for quality in (80, 65, 50, 35, 20):
        buffer = io.BytesIO()
        frames[0].save(
            buffer,
            "WEBP",
            save_all=True,
            append_images=frames[1:],
            duration=milliseconds,
            loop=0,
            quality=quality,
            method=4,
        )
        if buffer.tell() <= LARGEST:
            return buffer.getvalue()
    raise SystemExit(f"the film has {buffer.tell()} bytes at its worst: choose a smaller --width")


def main() -> None:
    """Start the simulator, press, and write the film."""
    parser = argparse.ArgumentParser(description="a film of a press in the browser")
    beside = Path(__file__).resolve().parent / "viewing" / "press.webp"
    parser.add_argument("--out", type=Path, default=beside)
    parser.add_argument("--width", type=int, default=800, help="of the film, pixels")
    parser.add_argument("--rate", type=float, default=12.0, help="pictures a second")
    asked = parser.parse_args()
    command = [sys.executable, "-m", "us_sim", "view", "upper_arm", "--port", "0"]
    said = Path(tempfile.mkdtemp(), "said.txt")
    with said.open("w", encoding="utf-8") as stream:
        process = subprocess.Popen(command, stdout=stream, stderr=stream, text=True)
    try:
        address = address_of(process, said)
        with sync_playwright() as tool:
            chromium = os.environ.get("US_SIM_TEST_CHROMIUM") or shutil.which("chromium")
            browser = tool.chromium.launch(executable_path=chromium, args=list(ARGUMENTS))
            page = browser.new_page(viewport={"width": 1280, "height": 720})
            page.goto(address)
            size = asked.width, round(asked.width * 720 / 1280)
            frames = [each.resize(size, Image.Resampling.LANCZOS) for each in pictures(page)]
            browser.close()
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(60)
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    asked.out.write_bytes(film(frames, round(1000 / asked.rate)))
    print(f"{asked.out}: {len(frames)} pictures, {asked.out.stat().st_size} bytes")


if __name__ == "__main__":
    main()
