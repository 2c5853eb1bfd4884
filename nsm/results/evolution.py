"""The evolution strip: pictures of a training side by side."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image

from nsm.results.files import atomic_write

_MOST = 65_500  # pixels of width: formats and viewers end near 2¹⁶


def extend_strip(file: Path, picture: np.ndarray, place: int) -> None:
    """Put a picture at its place into the strip in a file, which begins with the first picture.

    What the file has from that place on is dropped: an interrupted training goes on from a
    checkpoint that may be older.

    Args:
        file: a PNG, made if it is not there.
        picture: (H, W, 3) uint8, of equal size throughout a training.
        place: its number, from 0.
    """
    width = picture.shape[1]
    if (place + 1) * width > _MOST:
        return
    before = np.zeros((picture.shape[0], 0, 3), dtype=np.uint8)
    if place and file.exists():
        with Image.open(file) as image:
            before = np.asarray(image.convert("RGB"))[:, : place * width]
        if before.shape[0] != picture.shape[0]:  # of other settings
            before = before[:0].reshape(picture.shape[0], 0, 3)
    data = io.BytesIO()
    Image.fromarray(np.concatenate([before, picture], axis=1)).save(data, format="PNG")
    atomic_write(file, data.getvalue())
