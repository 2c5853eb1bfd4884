"""Cases that a fuzzer found, and arbitrary input: NsmError or a right result, nothing else."""

from pathlib import Path

import numpy as np
import pytest
from corpus_targets import TARGETS
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from nsm.errors import NsmError
from nsm.surfaces import Surface

CORPUS = Path(__file__).parent / "corpus"


@pytest.mark.parametrize("name", TARGETS)
def test_found_cases(name):
    for file in sorted((CORPUS / name).glob("*")):
        TARGETS[name](file.read_bytes())


@pytest.mark.parametrize("name", TARGETS)
@settings(max_examples=15, deadline=None)
@given(data=st.binary(max_size=300))
def test_any_bytes(name, data):
    TARGETS[name](data)


_DTYPES = st.sampled_from([np.float64, np.float32, np.int32, np.int64, bool, complex])
_SHAPES = arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)


@settings(max_examples=40, deadline=None)
@given(
    vertices=arrays.arrays(_DTYPES, _SHAPES),
    faces=arrays.arrays(_DTYPES, _SHAPES),
)
def test_surfaces_of_any_arrays(vertices, faces):
    try:
        surface = Surface.from_arrays(vertices, faces)
    except NsmError:
        return
    assert surface.quality["flipped_triangles"] == 0


@settings(max_examples=40, deadline=None)
@given(
    vertices=arrays.arrays(
        np.float64, (6, 3), elements=st.floats(-1e6, 1e6) | st.sampled_from([np.nan, np.inf, 0.0])
    ),
    faces=arrays.arrays(np.int64, (5, 3), elements=st.integers(-1, 6)),
)
def test_surfaces_of_any_few_triangles(vertices, faces):
    try:
        surface = Surface.from_arrays(vertices, faces)
    except NsmError:
        return
    assert surface.quality["flipped_triangles"] == 0
    assert np.isfinite(surface.uv).all()
