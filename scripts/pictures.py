# SPDX-License-Identifier: Apache-2.0
"""Draw the pictures of the pages: ``make pictures``, which takes six minutes.

The simulated robot is identified, tuned, driven and commissioned, and headless Chromium shows the
resulting pages. An argument names a folder that keeps the results for later runs.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
FIGURES = ROOT / "docs" / "figures"
sys.path.insert(0, str(ROOT / "test"))

from browser import CHROMIUM, Browser, Clicks  # noqa: E402

from smp_motor_ident.cli.processes import loopback_environment  # noqa: E402

DOMAIN = "87"
"""Default ROS domain of the simulated robot."""
WIDTH = 1280
"""Width of the window [px]."""
COLOURS = 96
"""Colours of a picture, which keep it below 100 kB."""
PARTS = {
    "report": ("tuned/report.html", ("#front_left",)),
    "tuning": ("tuned/report.html", ("#tuning h2", "#figure-tuning-step", "#figure-tuning-load")),
    "commissioning": ("trial/report.html", ("h1", "#results")),
}
"""Page of each picture, and its outermost elements."""
LAB = {
    "watch": (".bar", ".grid"),
    "identify": ("#identify-title", "#motors"),
    "tune": ("#tune-title", ".sliders", "#tune-charts"),
    "drive": ("#drive-title", "#settled"),
}
"""Outermost elements of each picture of the page of lab."""


@contextmanager
def running(*command: str) -> Iterator[None]:
    """Run a command until the block ends."""
    process = subprocess.Popen(command)
    try:
        yield
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(timeout=30)


def prepare(folder: Path) -> None:
    """Write the results that the pictures show, unless the folder holds them."""

    def run(*command: str) -> None:
        print("pictures:", *command, flush=True)
        subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)

    os.environ.update({"ROS_DOMAIN_ID": DOMAIN, **loopback_environment(), **os.environ})
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "demo").exists():
        run("demo", "--output", "demo")
    if not (folder / "tuned").exists():
        run("identify", "demo/excitation", "--output", "tuned", "--tuning")
    if not (folder / "trial").exists():
        with running("motor_plant"):
            run("commission", "--output", "trial", "--amplitude", "6", "--yes")


def draw(folder: Path) -> None:
    """Write every picture."""
    shutil.copy(folder / "demo" / "drive.svg", FIGURES / "drive.svg")
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
        Browser(Path(profile)) as browser,
    ):
        for name, (page, parts) in PARTS.items():
            browser.open(folder / page, WIDTH)
            path = FIGURES / f"{name}.png"
            browser.picture(path, *parts)
            shrink(path)


def draw_lab(folder: Path) -> None:
    """Use the page of lab, and write its pictures."""
    log = folder / "lab.log"
    shutil.rmtree(folder / "lab_output", ignore_errors=True)
    command = f"cd '{folder}' && exec lab --demo --no-browser > lab.log 2>&1"
    log.unlink(missing_ok=True)
    with (
        running("bash", "-c", command),
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
    ):
        while not (log.exists() and (found := re.findall(r"http://\S+", log.read_text()))):
            time.sleep(0.5)
        with Browser(Path(profile)) as browser:
            page = Clicks(browser)
            browser.open(found[-1], WIDTH)

            def draw(name: str) -> None:
                path = FIGURES / f"lab_{name}.png"
                browser.drawn()
                browser.picture(path, *LAB[name])
                shrink(path)

            page.until("Number(document.body.dataset.frames) >= 10")
            page.arm()
            page.set("seconds", 15)
            page.click("excite")
            page.until("document.getElementById('job').innerText.includes('14 of 15')")
            draw("watch")
            page.click("identify")
            page.until("document.getElementById('motors').innerText.includes('identified')")
            draw("identify")
            page.click("tune")
            page.until("document.querySelectorAll('#rows tr').length > 5")
            for wheel in ("front_right", "rear_left", "rear_right", "front_left"):
                page.set("wheel", wheel, "change")
                page.arm()
                page.click("apply")
                page.until("document.getElementById('trial').innerText.startsWith('On trial')")
                if wheel == "front_left":
                    draw("tune")
                page.click("keep")
                page.until("document.getElementById('trial').innerText === ''")
            page.arm()
            page.value("document.getElementById('pad').focus()")
            page.press("keyDown", "ArrowUp")
            time.sleep(2.5)
            draw("drive")
            page.press("keyUp", "ArrowUp")


def shrink(path: Path) -> None:
    """Reduce a picture to the colours of a page."""
    with Image.open(path) as shot:
        drawn = shot.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    drawn.save(path, optimize=True)
    print(f"pictures: {path.relative_to(ROOT)}: {path.stat().st_size / 1e3:.0f} kB")


def main(arguments: list[str]) -> int:
    """Write all pictures, or say what is missing."""
    if not CHROMIUM:
        print("pictures: no Chromium found: apt install chromium", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(arguments[0] if arguments else temporary).resolve()
        prepare(folder)
        draw(folder)
        draw_lab(folder)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
