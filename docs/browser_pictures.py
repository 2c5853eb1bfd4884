"""Take the pictures of pages in docs/pictures, with headless Chromium.

python docs/browser_pictures.py tensorboard FOLDER   # runs, as of nsm -m sweep=activation
python docs/browser_pictures.py report FILE          # a page that nsm report wrote
python docs/browser_pictures.py view FOLDER          # the run of a map
"""

from __future__ import annotations

import io
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from PIL import Image
from selenium import webdriver

import nsm

PICTURES = Path(__file__).parent / "pictures"
READY = 30  # seconds that a page has to draw itself; none says when it is ready
# of a shape, to the right, upwards and to the viewer: where points are picked
PICKED = {0: ([1.0, 0.4, 1.0], [-0.2, -1.0, 0.7]), 1: ([0.0, 0.3, 1.0],)}


@contextmanager
def browser(width: int, height: int) -> Iterator[Any]:
    """A window of Chromium."""
    options = webdriver.ChromeOptions()
    drawing = ("use-angle=swiftshader", "enable-unsafe-swiftshader")
    for word in ("headless", "no-sandbox", "no-first-run", *drawing):
        options.add_argument(f"--{word}")
    options.add_argument(f"--window-size={width},{height}")
    options.binary_location = shutil.which("chromium") or ""
    with tempfile.TemporaryDirectory() as profile:
        options.add_argument(f"--user-data-dir={profile}")
        service = webdriver.ChromeService(shutil.which("chromedriver"))
        window = webdriver.Chrome(options=options, service=service)
        try:
            yield window
        finally:
            window.quit()


def picture(window: Any, name: str, colours: int) -> None:
    """Keep what a window shows, with so many colours: the file is small."""
    shot = Image.open(io.BytesIO(window.get_screenshot_as_png())).convert("RGB")
    file = PICTURES / f"{name}.png"
    shot.quantize(colours).save(file, optimize=True)
    print(f"{file}: {file.stat().st_size / 1000:.0f} kB")


def tensorboard(folder: str) -> None:
    from tensorboard import program

    board = program.TensorBoard()
    board.configure(argv=[None, "--logdir", folder, "--port", "0", "--load_fast=false"])
    address = board.launch()
    with browser(2900, 700) as window:
        window.get(f"{address}#hparams")
        time.sleep(READY)
        picture(window, "tensorboard", 64)


def report(file: str) -> None:
    with browser(1250, 2500) as window:
        window.get(Path(file).resolve().as_uri())
        time.sleep(READY)
        picture(window, "report", 128)


def view(folder: str) -> None:
    from nsm.results.view import serving

    with (
        serving(nsm.load(folder), "127.0.0.1", 0) as (viewer, address),
        browser(1300, 760) as window,
    ):
        window.get(address)
        time.sleep(READY)
        scene, origin = viewer.scene, viewer.scene.camera[0]
        for side, ways in PICKED.items():
            for way in ways:
                vertices = scene.shapes[side].vertices
                seen = (vertices @ (np.array(way) @ scene.frame)).argmax()
                ray = vertices[seen] + scene.offsets[side] - origin
                viewer.on_click(SimpleNamespace(ray_origin=tuple(origin), ray_direction=tuple(ray)))
        time.sleep(READY / 3)
        # viser's notice that the browser draws without a GPU
        gone = "document.querySelectorAll('[class*=Notification]').forEach(e => e.remove())"
        window.execute_script(gone)
        picture(window, "view", 256)


if __name__ == "__main__":
    kinds: dict[str, Callable[[str], None]] = {
        "tensorboard": tensorboard,
        "report": report,
        "view": view,
    }
    kind, given = sys.argv[1:]
    kinds[kind](given)
