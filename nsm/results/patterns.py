"""Flattened surfaces as drawings for cutting and sewing: SVG and DXF, with a scale bar."""

from __future__ import annotations

import io
import math
from pathlib import Path

import numpy as np

from nsm.results.files import atomic_write
from nsm.surfaces.topology import boundary_loops

_MARGIN = 0.05  # of the larger side
_BAR = 0.25  # the scale bar is at most this share of the width
_DIGITS = 9


def write_patterns(stem: Path, uv: np.ndarray, faces: np.ndarray) -> None:
    """Write the outline of a flattened mesh as STEM.svg and STEM.dxf.

    Both are in the units of uv. A unit is a millimetre on the paper of the SVG; the DXF names no
    unit. The outline is seen from outside the surface; y goes up in both.

    Args:
        stem: path of the files without their endings.
        uv: (V, 2) in the units of the mesh file.
        faces: (F, 3).

    Raises:
        OSError: the folder cannot be written.
    """
    outlines = [uv[loop] for loop in boundary_loops(faces)]
    low = np.concatenate(outlines).min(axis=0)
    outlines = [outline - low for outline in outlines]
    extent = np.concatenate(outlines).max(axis=0)
    bar = round_length(_BAR * float(extent[0]))
    atomic_write(stem.with_suffix(".svg"), _svg(outlines, extent, bar))
    atomic_write(stem.with_suffix(".dxf"), _dxf(outlines, extent, bar))


def round_length(most: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is at most a length > 0."""
    power = 10.0 ** math.floor(math.log10(most))
    return max(factor * power for factor in (0.5, 1, 2, 5) if factor * power <= most)


def _label(bar: float) -> str:
    return f"{bar:g} unit" if bar == 1 else f"{bar:g} units"


def _svg(outlines: list[np.ndarray], extent: np.ndarray, bar: float) -> bytes:
    margin = _MARGIN * float(extent.max())
    width, height = (float(side) + 2 * margin for side in extent)
    height += 2 * margin  # the scale bar stands below
    line, text = 0.1 * margin, 0.6 * margin
    paths = []
    for outline in outlines:
        places = np.stack([outline[:, 0] + margin, extent[1] + margin - outline[:, 1]], axis=1)
        points = " L ".join(f"{x:.{_DIGITS}g},{y:.{_DIGITS}g}" for x, y in places.tolist())
        paths.append(f'<path class="cut" d="M {points} Z"/>')
    base = height - margin
    style = f'fill="none" stroke="black" stroke-width="{line:.4g}"'
    words = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.{_DIGITS}g}mm" '
        f'height="{height:.{_DIGITS}g}mm" viewBox="0 0 {width:.{_DIGITS}g} {height:.{_DIGITS}g}">',
        f"<g {style}>",
        *paths,
        f'<path class="scale" d="M {margin:.{_DIGITS}g},{base:.{_DIGITS}g} h {bar:.{_DIGITS}g}"/>',
        "</g>",
        f'<text x="{margin:.4g}" y="{base - 0.3 * margin:.6g}" font-size="{text:.4g}" '
        f'font-family="sans-serif">{_label(bar)}</text>',
        "</svg>",
    ]
    return ("\n".join(words) + "\n").encode()


def _dxf(outlines: list[np.ndarray], extent: np.ndarray, bar: float) -> bytes:
    import ezdxf

    margin = _MARGIN * float(extent.max())
    drawing = ezdxf.new("R2010", units=0)  # type: ignore[attr-defined]  # 0: no unit
    for layer in ("CUT", "SCALE"):
        drawing.layers.add(layer)
    space = drawing.modelspace()
    for outline in outlines:
        space.add_lwpolyline(outline.tolist(), close=True, dxfattribs={"layer": "CUT"})
    on_scale = {"layer": "SCALE"}
    space.add_line((0, -2 * margin), (bar, -2 * margin), dxfattribs=on_scale)
    text = space.add_text(_label(bar), height=0.6 * margin, dxfattribs=on_scale)
    text.set_placement((0, -1.7 * margin))
    stream = io.StringIO()
    drawing.write(stream)
    return stream.getvalue().encode(drawing.output_encoding)
