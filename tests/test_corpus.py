"""Cases found by a fuzzer, and random bytes: NsmError or a valid result."""

from pathlib import Path

import pytest
from corpus_targets import TARGETS, seeds
from hypothesis import given
from hypothesis import strategies as st
from thorough import examples

CORPUS = Path(__file__).parent / "corpus"


@pytest.mark.parametrize("name", TARGETS)
def test_found_cases(name):
    for file in sorted((CORPUS / name).glob("*")):
        TARGETS[name](file.read_bytes())


@pytest.mark.parametrize("name", TARGETS)
@examples(15)
@given(data=st.binary(max_size=300))
def test_any_bytes(name, data):
    TARGETS[name](data)


@pytest.mark.parametrize("name", TARGETS)
@examples(10)
@given(data=st.data())
def test_valid_files_with_replaced_parts(name, data):
    for seed in seeds(name):
        assert TARGETS[name](seed)
        start = data.draw(st.integers(0, len(seed)))
        end = data.draw(st.integers(start, min(len(seed), start + 40)))
        TARGETS[name](seed[:start] + data.draw(st.binary(max_size=20)) + seed[end:])
