"""Take the picture of TensorBoard in docs/pictures, with headless Chromium.

    python docs/tensorboard_picture.py FOLDER

FOLDER holds the runs, such as those of ``nsm -m sweep=activation``.
"""

from __future__ import annotations

import io
import shutil
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image
from selenium import webdriver
from tensorboard import program

PICTURE = Path(__file__).parent / "pictures" / "tensorboard.png"
WIDTH, HEIGHT = 2100, 700
COLOURS = 64  # enough for a page of text, and the file is small


def main(folder: str) -> None:
    board = program.TensorBoard()
    board.configure(argv=[None, "--logdir", folder, "--port", "0", "--load_fast=false"])
    address = board.launch()
    options = webdriver.ChromeOptions()
    for word in ("headless", "no-sandbox", "no-first-run", f"window-size={WIDTH},{HEIGHT}"):
        options.add_argument(f"--{word}")
    with tempfile.TemporaryDirectory() as profile:
        options.add_argument(f"--user-data-dir={profile}")
        options.binary_location = shutil.which("chromium") or ""
        driver = webdriver.ChromeService(shutil.which("chromedriver"))
        window = webdriver.Chrome(options=options, service=driver)
        try:
            window.get(f"{address}#hparams")
            time.sleep(30)  # TensorBoard reads the files; its page does not say when it is ready
            shot = Image.open(io.BytesIO(window.get_screenshot_as_png()))
        finally:
            window.quit()
    shot.convert("RGB").quantize(COLOURS).save(PICTURE, optimize=True)
    print(f"{PICTURE}: {PICTURE.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(*sys.argv[1:])
