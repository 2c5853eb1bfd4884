"""landmarks=auto: what is said, written and refused, with a proposal that is known."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from rich.console import Console

from nsm.correspondence import Hypothesis, Proposal
from nsm.domains import DOMAINS
from nsm.domains.joint_preparation import Mesh
from nsm.errors import NsmError
from nsm.pipeline import proposed_landmarks
from nsm.pipeline.proposed_landmarks import asks_for_proposal, propose_landmarks
from nsm.surfaces.landmark_files import read_pairs
from nsm.surfaces.shapes import sphere
from nsm.surfaces.validation import Repairs


def meshes():
    """Two spheres; the first vertex of the second is in no triangle, and is removed."""
    vertices, faces = sphere()
    return [
        Mesh("a", vertices, faces),
        Mesh("b", np.concatenate([[[9.0, 9.0, 9.0]], vertices]), faces + 1),
    ]


def answers(monkeypatch, margin, score=2.0):
    """Let the search answer with two hypotheses, in the numbers of cleaned meshes."""
    found = [
        Hypothesis(np.array([[k, 10 + k] for k in range(first, first + 4)]), s, 5.0, 0, 0, None)
        for first, s in ((0, score), (20, score + margin))
    ]
    monkeypatch.setattr(proposed_landmarks, "proposed", lambda *_: Proposal(found, margin))


def proposed_with(margin, monkeypatch, strict=False, alternative=0, score=2.0):
    answers(monkeypatch, margin, score)
    console = Console(record=True, width=300)
    found = propose_landmarks(meshes(), strict, alternative, True, console)
    return found, console.export_text()


def test_a_sure_proposal_is_taken_in_the_numbers_of_the_files(monkeypatch, tmp_path):
    given, said = proposed_with(0.5, monkeypatch)
    # the second file has a vertex more in front
    assert given.landmarks == {"source": [0, 1, 2, 3], "target": [11, 12, 13, 14]}
    assert "WARNING" not in said and "0.500" in said
    (tmp_path / "landmarks.json").write_text(given.to_json())
    source, target = read_pairs(tmp_path / "landmarks.json")
    assert {"source": source, "target": target} == given.landmarks


def test_an_unsure_one_is_a_warning_or_an_error(monkeypatch):
    for margin, score in ((0.01, 2.0), (0.5, 3.5)):
        _, said = proposed_with(margin, monkeypatch, score=score)
        assert "WARNING" in said
        with pytest.raises(NsmError) as refused:
            proposed_with(margin, monkeypatch, strict=True, score=score)
        assert (refused.value.kind, refused.value.key) == ("unsure_landmarks", "proposal.strict")
    proposed_with(0.5, monkeypatch, strict=True)


def test_the_second_best_is_one_flag_away(monkeypatch):
    given, _ = proposed_with(0.01, monkeypatch, alternative=1)
    assert given.landmarks["source"] == [20, 21, 22, 23]
    assert '"source": [0, 1, 2, 3]' in given.to_json()  # the best is kept among alternatives
    with pytest.raises(NsmError) as refused:
        proposed_with(0.01, monkeypatch, alternative=2)
    assert (refused.value.kind, refused.value.key) == ("out_of_range", "proposal.alternative")


def test_only_meshes_are_proposed_for():
    with pytest.raises(NsmError) as refused:
        propose_landmarks([meshes()[0], SimpleNamespace()], False, 0, True, Console(quiet=True))
    assert (refused.value.kind, refused.value.key) == ("wrong_type", "landmarks")


def test_closed_meshes_without_landmarks_have_some_proposed():
    orbifold, disc = DOMAINS["orbifold"], DOMAINS["disc"]
    assert asks_for_proposal(None, meshes(), orbifold)
    assert asks_for_proposal("auto", meshes(), disc)
    for landmarks, shapes, domain in (
        (None, meshes(), disc),
        ([], meshes(), orbifold),
        ("pairs.json", meshes(), orbifold),
        (None, [meshes()[0], SimpleNamespace()], orbifold),
    ):
        assert not asks_for_proposal(landmarks, shapes, domain)


def test_shapes_without_a_proposal_are_mapped_without_landmarks_unless_asked(monkeypatch):
    def nothing(*_):
        raise NsmError("no tips", kind="no_proposal", key="landmarks")

    monkeypatch.setattr(proposed_landmarks, "proposed", nothing)
    console = Console(record=True, width=300)
    assert propose_landmarks(meshes(), False, 0, False, console) is None
    assert "no tips" in console.export_text()
    for strict, asked in ((True, False), (False, True)):
        with pytest.raises(NsmError):
            propose_landmarks(meshes(), strict, 0, asked, Console(quiet=True))


def test_a_proposal_is_for_the_part_that_is_kept(monkeypatch):
    answers(monkeypatch, 0.5)
    vertices, faces = sphere()
    both = (
        np.concatenate([vertices, 0.3 * vertices + 5]),
        np.concatenate([faces, faces + len(vertices)]),
    )
    shapes = [meshes()[0], Mesh("both", *both)]
    console = Console(quiet=True)
    with pytest.raises(NsmError) as refused:
        propose_landmarks(shapes, False, 0, True, console)
    assert refused.value.kind == "disconnected"
    assert propose_landmarks(shapes, False, 0, True, console, Repairs("largest")) is not None


def test_the_command_trains_with_them_and_leaves_the_file(here, tmp_path, monkeypatch):
    answers(monkeypatch, 0.01)
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.export(tmp_path / "a.obj")
    ball.vertices = ball.vertices * [1.2, 1.0, 0.9]
    ball.export(tmp_path / "b.obj")
    words = ["task=pair_map", "source=a.obj", "target=b.obj", "landmarks=auto"]
    words += ["experiment=quick", "trainer.max_steps=4", "artefacts=false", "seam.path=shortest"]
    words += ["hydra.run.dir=run", 'phi.overrides=["experiment=quick","trainer.max_steps=4"]']
    strict = here(*words, "proposal.strict=true")
    assert strict.returncode == 2 and "proposal.strict" in strict.stderr
    assert not (tmp_path / "run").exists()
    run = here(*words)
    assert run.returncode == 0, run.stderr
    assert "WARNING" in run.stdout
    source, target = read_pairs(tmp_path / "run" / "landmarks.json")
    assert (source, target) == ([0, 1, 2, 3], [10, 11, 12, 13])
