"""The quick cases of ``make torture``, and its stored results."""

import json
import os
import sys
import time
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
torture = pytest.importorskip("torture.__main__")

QUICK = (
    "scale 1e-40",
    "Möbius strip",
    "book of three pages",
    "chessboard",
    "two parts",
    "at a point",
    "NaN",
    "one triangle domain=square",
    "landmark twice",
    "landmark of text",
    "binary.ply: first 50%",
    "glb: noise",
    "stl: a letter",
    "GLTF of 1e8 copies",
    "PLY of 1e18 faces",
    "OBJ in UTF-16",
    "face of vertex 1e30",
    "name with ${}",
    "a link to itself",
    "outputs is a file",
    "no file above 2 kB",
    "needles 1e-13",
)
CASES = {case.name: case for case in torture.all_cases()}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize("name", QUICK)
def test_the_result_is_correct_or_refused_in_one_line(name):
    trial = torture.Trial(CASES[name], torture.SECONDS)
    while (result := trial.result()) is None:
        time.sleep(0.01)
    assert result["outcome"] != torture.FAILED, result["complaints"]


def test_names_of_cases_are_unique():
    names = [(case.group, case.name) for case in torture.all_cases()]
    assert len(set(names)) == len(names)


def test_wrong_outcomes_are_noticed(tmp_path):
    """No message, a second line, a traceback, or a result of a refused run is a failure."""
    case = CASES["Möbius strip"]

    def judged(status, stderr, left=()):
        return torture._judge(case, status, "", stderr, tmp_path, set(left))

    assert judged(2, "nsm: mesh: one-sided\n") == (torture.REFUSED, "mesh: one-sided", [])
    assert judged(2, "nsm: a\nnsm: b\n")[2] and judged(2, "")[2] and judged(1, "nsm: a\n")[2]
    assert judged(2, "nsm: a\n", [tmp_path / "metrics.json"])[2]
    assert judged(-9, "")[2] and judged(0, "")[2] and judged(2, "Traceback\n")[2]


def test_the_stored_results_have_all_cases_and_no_failure():
    results = json.loads(torture.RESULT.read_text())["cases"]
    assert {r["outcome"] for r in results} == {torture.SOLVED, torture.REFUSED}
    kept = {(r["group"], r["case"]) for r in results}
    assert kept >= {(case.group, case.name) for case in torture.all_cases()}
    assert torture.table(results) in torture.PAGE.read_text()
