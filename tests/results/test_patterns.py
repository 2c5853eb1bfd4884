"""Drawings of flattened surfaces: read back by an XML parser and by ezdxf, in file units."""

import math
import re
from xml.etree import ElementTree

import ezdxf
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from thorough import examples

from nsm.results.patterns import round_length, write_patterns
from nsm.surfaces.shapes import ring_mesh

SVG = "{http://www.w3.org/2000/svg}"


def area(points):
    x, y = points.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


@examples(10)
@given(st.floats(1e-3, 1e3), st.floats(-100, 100), st.integers(3, 9))
def test_drawings_have_the_size_of_the_outline(tmp_path_factory, size, shift, rings):
    folder = tmp_path_factory.mktemp("drawn")
    uv, faces = ring_mesh(rings)
    uv = size * (uv * [2.0, 1.0] + shift)
    write_patterns(folder / "flat", uv, faces)
    want = 2 * size**2 * 0.5 * 6 * rings * math.sin(2 * math.pi / (6 * rings))  # of the polygon

    root = ElementTree.parse(folder / "flat.svg").getroot()
    box = [float(word) for word in root.get("viewBox").split()]
    assert root.get("width") == f"{box[2]:.9g}mm" and root.get("height") == f"{box[3]:.9g}mm"
    cut, bar = (root.findall(f".//{SVG}path[@class='{name}']") for name in ("cut", "scale"))
    points = np.array(
        [[float(x) for x in pair.split(",")] for pair in re.findall(r"\S+,\S+", cut[0].get("d"))]
    )
    assert len(cut) == 1 and area(points * [1, -1]) == pytest.approx(want, rel=1e-5)
    assert points.min() > 0 and (points.max(axis=0) < box[2:]).all()
    length = float(bar[0].get("d").split(" h ")[1])
    assert root.find(f"{SVG}text").text == f"{length:g} units" and length <= 4 * size / 4 + 1e-12

    drawing = ezdxf.readfile(folder / "flat.dxf")
    assert drawing.units == 0 and not drawing.audit().has_errors
    space = drawing.modelspace()
    (outline,) = space.query("LWPOLYLINE")
    points = np.array(outline.get_points("xy"))
    assert outline.closed and area(points) == pytest.approx(want, rel=1e-5)
    (line,) = space.query("LINE")
    assert line.dxf.start.distance(line.dxf.end) == pytest.approx(length)
    assert space.query("TEXT")[0].dxf.text == f"{length:g} units"


@examples(50)
@given(st.floats(1e-6, 1e6))
def test_scale_bars_have_round_lengths(most):
    length = round_length(most)
    digits = f"{length:.6e}".split("e")[0]
    assert float(digits) in (1, 2, 5) and length <= most < 2.5 * length + 1e-9 * length
