"""Maps that are not certified say where, why, and what to do."""

from types import SimpleNamespace

import numpy as np
import pytest

from nsm.results import warning_of_faults

FLAT = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-9, 0], [0.5, 1, 0], [4, 0, 0], [4, 1, 0]], float)
FACES = np.array([[0, 1, 2], [2, 1, 3], [1, 4, 5]])


def sample(flips, landmarks=((0, 0), (4, 4)), **counts):
    """A map of three triangles, of which it flips some."""
    image = FLAT[:, :2].copy()
    faces = FACES.copy()
    faces[flips] = faces[flips][:, ::-1]
    source = SimpleNamespace(
        surface=SimpleNamespace(vertices=FLAT, faces=faces),
        in_original_units=lambda x: 10 * x,
        file_mesh=lambda: (10 * FLAT, faces),
    )
    counted = {"certified": not flips and not counts, "flipped_triangles": len(flips), **counts}
    return SimpleNamespace(
        certificate=counted,
        image_uv=image,
        source=source,
        landmarks=np.array(landmarks, dtype=int).reshape(-1, 2),
    )


def test_a_certified_map_has_no_faults():
    assert warning_of_faults("a → b", sample([])) is None


@pytest.mark.parametrize(
    ("flips", "words", "others"),
    [
        ([0], ["1 of them are thinner", "remesh"], ["landmark"]),
        ([2], ["(30, 3.33333, 0)", "Correct or leave out landmark 1"], ["thinner"]),
        ([0, 2], ["1 of them are thinner", "otherwise correct or leave out landmark 1"], []),
    ],
)
def test_the_cause_and_what_to_do_are_told(flips, words, others):
    said = warning_of_faults("a → b", sample(flips)).plain
    assert said.startswith(f"a → b: NOT certified ({len(flips)} flipped triangles)")
    assert all(word in said for word in words) and not any(word in said for word in others)


def test_faults_without_flips_or_landmarks_are_told_too():
    assert "Give landmarks" in warning_of_faults("a → b", sample([2], landmarks=())).plain
    said = warning_of_faults("a → b", sample([], boundary_order_violations=2)).plain
    assert "2 boundary order violations" in said and "Train longer" in said
