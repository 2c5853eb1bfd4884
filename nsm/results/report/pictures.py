"""The pictures of a run, reduced in size for a page with many runs."""

from __future__ import annotations

import base64
import io
from pathlib import Path

from PIL import Image

from nsm.results.report.runs import short

_WIDTH = 1000
UNREADABLE = (OSError, ValueError, SyntaxError, Image.DecompressionBombError)


def read_pictures(folder: Path) -> tuple[dict[str, str], list[str]]:
    """The data URIs of the pictures of a run folder by name, and remarks on damaged files."""
    pictures: dict[str, str] = {}
    remarks = []
    for file in sorted(folder.glob("*.png")):
        if file.stem.endswith("_texture"):
            continue
        try:
            pictures[file.stem] = read_picture(file)
        except UNREADABLE as error:
            remarks.append(f"{file.name}: {short(error)}")
    return pictures, remarks


def read_picture(file: Path, tallest: int = 2 * _WIDTH) -> str:
    """The data URI of a picture, reduced to at most 1000 pixels in width and to a height."""
    with Image.open(file) as image:
        image.thumbnail((_WIDTH, tallest))
        data = io.BytesIO()
        image.convert("RGB").save(data, format="WEBP", quality=82)
    return f"data:image/webp;base64,{base64.b64encode(data.getvalue()).decode()}"
