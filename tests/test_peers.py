"""The adapter of other programs, with a small script in their place."""

import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

from nsm.surfaces import shapes

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
import correspondence  # noqa: E402
import peers  # noqa: E402

SCRIPT = """
import sys
import numpy as np
source, target, landmarks, image = sys.argv[1:]
vertices = [line.split()[1:] for line in open(source) if line.startswith("v ")]
moved = np.array(vertices, dtype=float) * [2, 2, 2] + [5, 0, 0]
pairs = np.loadtxt(landmarks, dtype=int, ndmin=2)
assert (pairs[:, 0] == pairs[:, 1]).all() and open(target).read().count("\\nf ") > 3
MEND
np.savetxt(image, moved)
"""
MARKS = np.array([[0, 0], [9, 9], [30, 30]])


def peer(tmp_path, change=""):
    """The command of a mapper between spheres, which doubles and moves its source."""
    file = tmp_path / "a peer.py"
    file.write_text(SCRIPT.replace("MEND", change))
    words = [sys.executable, str(file)]
    return f"{shlex.join(words)} {{source}} {{target}} {{landmarks}} {{image}}"


@pytest.fixture(scope="module")
def meshes():
    vertices, faces = shapes.sphere(3)
    return (vertices, faces), (2 * vertices + [5, 0, 0], faces)


def test_an_exact_similarity_has_the_least_distortion(tmp_path, meshes):
    found = peers.by_command(peer(tmp_path), *meshes, MARKS)
    least = 2 + 2 / 1.01  # symmetric Dirichlet of an isometry (METHOD, Eq. 2)
    assert found["symmetric_dirichlet_median"] == pytest.approx(least, abs=1e-5)
    assert found["symmetric_dirichlet_p95"] == pytest.approx(least, abs=1e-5)
    assert found["turned_percent"] == 0 and found["landmark_error_max_percent"] < 1e-5
    assert found["seconds"] >= 0


def test_flips_and_missed_landmarks_are_seen(tmp_path, meshes):
    """A reflection turns all triangles; two of the landmarks are not on the mirror."""
    found = peers.by_command(peer(tmp_path, "moved[:, 1] *= -1"), *meshes, MARKS)
    assert found["turned_percent"] > 99
    (vertices, _), (other, _) = meshes
    y = vertices[MARKS[:, 0], 1]
    off = 100 * 4 * np.abs(y) / np.linalg.norm(np.ptp(other, axis=0))
    assert found["landmark_error_max_percent"] == pytest.approx(off.max(), rel=1e-4)
    assert found["landmark_error_mean_percent"] == pytest.approx(off.mean(), rel=1e-4)


def test_a_mesh_may_be_written_in_place_of_points(tmp_path, meshes):
    write = "image += '.obj'; faces = [line for line in open(source) if line.startswith('f ')]\n"
    write += "open(image, 'w').writelines(['v %r %r %r\\n' % tuple(map(float, x)) for x in moved])"
    write += "\nopen(image, 'a').writelines(faces); sys.exit()"
    found = peers.by_command(peer(tmp_path, write), *meshes, MARKS)
    assert found["turned_percent"] == 0 and found["landmark_error_max_percent"] < 1e-5


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("sys.exit('no such licence')", "status 1: no such licence"),
        ("sys.exit()", "wrote no image"),
        ("moved = moved[:3]", "for 642 vertices"),
        ("open(image, 'w').write('x y z'); sys.exit()", "no table of points"),
    ],
)
def test_a_program_that_fails_is_told(tmp_path, meshes, change, words):
    with pytest.raises(RuntimeError, match=words):
        peers.by_command(peer(tmp_path, change), *meshes, MARKS)


def test_without_a_command_the_peer_is_skipped(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(peers, "RESULTS", tmp_path / "peers.json")
    words = ["peers.py", "--meshes", str(tmp_path), "--pairs", "--flatten", "--name", "theirs"]
    monkeypatch.setattr(sys, "argv", words)
    peers.main()
    assert "theirs: skipped, as there is no --command" in capsys.readouterr().out


@pytest.mark.parametrize("rows, status", [(["--rows", "none", "icp"], 2), ([], 0)])
def test_correspondences_without_pyfmaps_say_so_first(tmp_path, monkeypatch, capsys, rows, status):
    """Rows that were asked for stop it; by default the others are measured."""
    monkeypatch.setattr(correspondence, "find_spec", lambda _: None)
    measured = []
    shape = correspondence.Annotated(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    monkeypatch.setattr(correspondence, "annotated", lambda *_: shape)
    monkeypatch.setattr(correspondence, "measured", lambda row, *_: measured.append(row) or {})
    monkeypatch.setattr(correspondence, "write", lambda _: None)
    monkeypatch.setattr(correspondence, "LINES", tmp_path / "lines.jsonl")
    monkeypatch.setattr(sys, "argv", ["correspondence.py", "--meshes", str(tmp_path), *rows])
    try:
        correspondence.main()
        ended = 0
    except SystemExit as stop:
        ended = stop.code
    said = capsys.readouterr().err.splitlines()
    assert ended == status and len(said) == 1
    assert "pyfmaps" in said[0] and "pip install '.[peers]'" in said[0]
    assert set(measured) == (set() if status else {"none", "none, full map"})
