"""The pictures of a run, small enough for a page of many."""

from __future__ import annotations

import base64
import io
from pathlib import Path

from PIL import Image

_WIDTH = 1000


def read_pictures(folder: Path) -> tuple[dict[str, str], list[str]]:
    """Name to data URI of each picture in a run folder, and remarks on those that are damaged."""
    pictures: dict[str, str] = {}
    remarks = []
    for file in sorted(folder.glob("*.png")):
        if file.stem.endswith("_texture"):
            continue
        try:
            with Image.open(file) as image:
                image.thumbnail((_WIDTH, 2 * _WIDTH))
                data = io.BytesIO()
                image.convert("RGB").save(data, format="WEBP", quality=82)
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            remarks.append(f"{file.name}: {' '.join(str(error).split())[:120]}")
            continue
        pictures[file.stem] = f"data:image/webp;base64,{base64.b64encode(data.getvalue()).decode()}"
    return pictures, remarks
