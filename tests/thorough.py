"""How many examples a property is tried on: few in CI, more by the environment's NSM_EXAMPLES."""

from __future__ import annotations

import os

from hypothesis import HealthCheck, settings

TIMES = int(os.environ.get("NSM_EXAMPLES", 1))


def examples(count: int) -> settings:
    """So many examples, times NSM_EXAMPLES; the same ones at each run where that is not set."""
    return settings(
        max_examples=count * TIMES,
        deadline=None,
        derandomize=TIMES == 1,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
    )
