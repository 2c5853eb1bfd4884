"""Landmarks of two shapes that fit each other, and those that do not."""

import json

import numpy as np
import pytest
import tiny
from rich.console import Console

import nsm
from nsm.correspondence import agreement
from nsm.domains.joint_preparation import Mesh
from nsm.pipeline.landmark_check import check_landmarks
from nsm.results import (
    warning_of_distortion,
    warning_of_folds,
    warning_of_misfit,
    warning_of_missed_landmarks,
)
from nsm.results.report.runs import find_runs
from nsm.surfaces.shapes import hemisphere, ring_mesh, sphere

PHI = (
    'phi.overrides=["experiment=quick","trainer.threads=1","encoding.resolutions=[4]",'
    '"data.batch_size=64","data.held_out=64","trainer.max_steps=2"]'
)


@pytest.fixture(autouse=True)
def no_coarse_maps(monkeypatch):
    """Distances alone; tests/correspondence/test_coarse_check.py has the coarse maps."""
    monkeypatch.setattr("nsm.pipeline.landmark_check.coarse_check", lambda *_: None)


def pair(meshes, landmarks):
    """The agreement of two meshes."""
    found = agreement(meshes, landmarks)
    return None if found is None else found.pairs[0, 1]


def shapes(scale=(5.0, 6.0, 4.0)):
    """A long sphere, and a bent copy in other units and with other vertex numbers."""
    vertices, faces = sphere()
    first = vertices * [1.0, 3.0, 1.0]
    order = np.random.default_rng(0).permutation(len(vertices))
    second = np.empty_like(vertices)
    second[order] = first * scale
    ids = np.linspace(0, len(vertices) - 1, 8).astype(int)
    return (first, faces), (second, order[faces]), ids, order[ids]


def test_right_landmarks_fit_whatever_the_units():
    one, other, a, b = shapes()
    found = pair([one, other], [a, b])
    assert found.correlation > 0.9 and not found.doubtful
    same = pair([one, (7 * one[0], one[1])], [a, a])
    assert same.correlation == pytest.approx(1) and same.spread.max() < 1e-12


def test_a_wrong_one_is_named_and_shuffled_ones_are_doubted():
    one, other, a, b = shapes()
    order = np.argsort(np.random.default_rng(1).random(8))
    assert pair([one, other], [a, b[order]]).doubtful
    moved = a.copy()
    k = int(one[0][a, 1].argmin())
    moved[k] = one[0][:, 1].argmax()  # from one pole to the other
    found = pair([one, one], [a, moved])
    assert found.doubtful and found.worst == k


def test_missing_ones_and_few_are_not_judged():
    one, other, a, b = shapes()
    lacking = np.where(np.arange(8) == 3, -1, b)
    found = pair([one, other], [a, lacking])
    assert np.isnan(found.each[3]) and not found.doubtful
    assert pair([one, other], [a[:4], b[:4]]) is None
    assert pair([one, other], [a, np.where(np.arange(8) < 4, b, -1)]) is None


def test_an_open_shape_is_judged_too():
    vertices, faces = hemisphere()
    ids = np.linspace(0, len(vertices) - 1, 9).astype(int)
    assert not pair([(vertices, faces)] * 2, [ids, ids]).doubtful
    assert pair([(vertices, faces)] * 2, [ids, ids[[4, 7, 1, 8, 0, 6, 2, 5, 3]]]).doubtful


def test_the_warning_names_the_worst():
    one, other, a, b = shapes()
    meshes = [Mesh("dog", *one), Mesh("calf", *other)]
    console = Console(record=True, width=600)
    check = check_landmarks(meshes, [a, b], console)
    assert check.warning is None and not check.figures["landmarks_doubtful"]
    assert check.figures["landmark_correlation"] > 0.9
    assert console.export_text() == ""
    order = np.argsort(np.random.default_rng(1).random(8))
    check = check_landmarks(meshes, [a, b[order]], console)
    said, k = console.export_text(), pair([one, other], [a, b[order]]).worst
    assert f"landmark {k} (vertex {a[k]} of dog, {b[order][k]} of calf)" in said
    assert check.warning.plain in said and check.figures["landmarks_doubtful"]


def test_of_a_collection_the_worst_surface_and_its_landmark_are_named():
    one, other, a, b = shapes()
    third = one[0] * [1.0, 1.2, 0.9], one[1]
    names = ["dog", "calf", "foal", "lamb"]
    meshes = [Mesh(n, *m) for n, m in zip(names, (one, other, third, one), strict=True)]
    console = Console(record=True, width=900)
    assert check_landmarks(meshes, [a, b, a, a], console).warning is None
    moved = a.copy()
    k = int(one[0][a, 1].argmin())
    moved[k] = one[0][:, 1].argmax()
    check = check_landmarks(meshes, [a, b, moved, a], console)
    assert check.found.worst == (2, k)
    assert "foal" in check.warning.plain and f"landmark {k} " in check.warning.plain
    lacking = np.where(np.arange(8) == k, -1, b)  # one surface lacks it
    assert check_landmarks(meshes, [a, lacking, moved, a], console).found.worst == (2, k)


def test_one_unlike_pair_of_many_is_no_doubt():
    one, other, a, b = shapes()
    found = agreement([one, other, one, one], [a, b, a, a])
    wrong = agreement([one, other], [a, b[np.argsort(np.random.default_rng(1).random(8))]])
    found.pairs[0, 1] = wrong.pairs[0, 1]
    assert wrong.doubtful and not found.doubtful
    few = np.where(np.arange(8) < 4, a, -1)
    assert agreement([one, one, one], [few] * 3) is None


def test_a_run_says_it_again_at_its_end(tmp_path):
    """A shuffled list for a dome and a longer one: in the map, in metrics.json, in the report."""
    uv, faces = ring_mesh(6)
    dome = np.column_stack([uv, 0.5 * (1 - (uv**2).sum(axis=1))])
    ids = np.flatnonzero((uv**2).sum(axis=1) < 0.8)[::9][:7]
    shuffled = ids[np.argsort(np.random.default_rng(0).random(7))]
    short = ["trainer.max_steps=2", "artefacts=false", "surface.parameterization=tutte", PHI]
    quick = {"overrides": [*tiny.QUICK, *short], "logger": "none"}
    ends = (dome, faces), (dome * [1, 1.2, 1], faces)
    folder = tmp_path / "run"
    pairs = np.stack([ids, shuffled], axis=1)
    f = nsm.map_pair(*ends, pairs, folder=folder, progress=False, **quick)
    assert f.metrics["landmarks_doubtful"] and f.metrics["landmark_correlation"] < 0.5
    said = json.loads((folder / "metrics.json").read_text())["warnings"]
    assert "landmarks do not fit" in said[0]
    runs, _ = find_runs([folder])
    assert list(runs[0].warnings) == said
    assert runs[0].figures["landmarks_doubtful"] == "yes"


def test_a_map_that_is_far_from_isometric_is_told():
    good = {"symmetric_dirichlet_median": 5.0, "symmetric_dirichlet_p95": 20.0}
    bad = {"symmetric_dirichlet_median": 30.0, "symmetric_dirichlet_p95": 900.0}
    assert warning_of_distortion({"a → b": good}) is None
    assert "a → b" in warning_of_distortion({"a → b": bad}).plain
    several = warning_of_distortion({"a → b": good, "b → c": bad, "c → a": good}).plain
    assert "1 of 3" in several and "b → c" in several and "30.0" in several


def test_a_missed_landmark_is_told():
    off = {"landmark_error_max_percent": 40.0, "landmark_error_mean_percent": 11.0}
    assert warning_of_missed_landmarks({"a → b": {}}) is None
    assert warning_of_missed_landmarks({"a → b": {**off, "landmark_error_max_percent": 1}}) is None
    said = warning_of_missed_landmarks({"a → b": {}, "b → a": off}).plain
    assert "1 of 2 maps, b → a most" in said and "40.0 %" in said and "11.0 %" in said


def test_a_surface_that_is_not_near_its_mesh_is_told():
    assert warning_of_misfit({"a": {}, "b": {"rms_percent": 0.02}}) is None
    said = warning_of_misfit({"a": {"rms_percent": 0.02}, "b": {"rms_percent": 24.0}}).plain
    assert said.startswith("1 of 2 surfaces, b most: φ is 24 % of the diagonal off the mesh")


def test_folds_before_the_repair_are_told_from_one_percent_on():
    key = "flipped_before_repair_percent"
    assert warning_of_folds({"a → b": {}, "b → a": {key: 0.4}}) is None
    assert "b → a" in warning_of_folds({"a → b": {}, "b → a": {key: 4.2}}).plain
