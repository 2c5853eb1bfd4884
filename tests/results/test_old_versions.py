"""Run folders that version 1 wrote give the same values."""

import json
from pathlib import Path

import numpy as np
import pytest

import nsm
from nsm.results.metrics import evaluate

FOLDER = Path(__file__).parents[1] / "data_v1"
EXPECTED = json.loads((FOLDER / "expected.json").read_text())
UV = np.array(EXPECTED["uv"])
RESULTS = sorted(name for name in EXPECTED if name != "uv" and "." not in name)


def values(result):
    if isinstance(result, nsm.SurfaceMap):
        return result.planar(UV)
    if isinstance(result, nsm.SurfaceCollection):
        return np.concatenate([result.pair(0, 1).planar(UV), result.pair(2, 0).planar(UV)])
    if isinstance(result, nsm.NeuralSurface):
        return evaluate(result.map, UV)
    return result(UV)


@pytest.mark.parametrize("name", RESULTS)
def test_results_of_version_1_have_their_values(name, tmp_path):
    result = nsm.load(FOLDER / name)
    np.testing.assert_allclose(values(result), EXPECTED[name], rtol=1e-5, atol=1e-6)
    if name.startswith("overfit"):
        slopes = EXPECTED[f"{name}.jacobian"]
        np.testing.assert_allclose(
            result.jacobian(UV) * result.surface.scale, slopes, rtol=1e-4, atol=1e-5
        )
    assert "_target_" in result.config["map"]
    result.save(tmp_path)
    np.testing.assert_array_equal(values(nsm.load(tmp_path)), values(result))


def test_an_analytic_surface_of_version_1():
    target = nsm.load(FOLDER / "pair_analytic" / "target")
    np.testing.assert_allclose(target(UV), EXPECTED["pair_analytic.target"], rtol=1e-6)
