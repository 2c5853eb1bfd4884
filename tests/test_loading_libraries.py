"""Imports of libraries leave the process as it was."""

import gc
import random
import subprocess
import sys

import pytest

from nsm.loading_libraries import loading_libraries


@pytest.fixture
def collecting():
    yield
    gc.enable()


@pytest.mark.parametrize("enabled", [True, False])
def test_the_collector_rests_and_goes_on_as_before(collecting, enabled):
    gc.enable() if enabled else gc.disable()
    frozen = gc.get_freeze_count()
    with pytest.raises(ImportError), loading_libraries(frozen=True):
        assert not gc.isenabled()
        raise ImportError
    assert gc.isenabled() == enabled
    assert gc.get_freeze_count() == frozen  # torch was there before


def test_random_numbers_drawn_meanwhile_do_not_count():
    state = random.getstate()
    with loading_libraries():
        random.random()
    assert random.getstate() == state


def test_results_load_without_lightning():
    code = (
        "import gc, sys, nsm; nsm.load; assert 'pytorch_lightning' not in sys.modules\n"
        "assert gc.isenabled() and not gc.get_freeze_count()"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True)
    assert result.returncode == 0, result.stderr
