"""landmarks=auto: what is said, written and refused, with a proposal that is known."""

import json
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from rich.console import Console
from tiny import results

from nsm import stages
from nsm.config import compose_config
from nsm.correspondence import CollectionProposal, Hypothesis, Proposal
from nsm.domains import DOMAINS, Surface
from nsm.domains.joint_preparation import Mesh
from nsm.errors import NsmError
from nsm.pipeline import pair_map, proposed_landmarks
from nsm.pipeline.proposed_landmarks import ProposedLandmarks, given_or_proposed
from nsm.pipeline.task import Given
from nsm.surfaces.landmark_files import read_collection, read_pairs
from nsm.surfaces.shapes import sphere, torus


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
        Hypothesis(np.array([[k, 10 + k] for k in range(n, n + 4)]), s, True, None)
        for n, s in ((0, score), (20, score + margin))
    ]

    def completed(source, target, given):
        kept = [replace(h, vertices=np.concatenate([given, h.vertices])) for h in found]
        return Proposal(kept, margin)

    monkeypatch.setattr(proposed_landmarks, "proposed", completed)


ORBIFOLD, TORUS, DISC = (DOMAINS[name] for name in ("orbifold", "torus", "disc"))


def take(landmarks, *words, shapes=None, domain=ORBIFOLD):
    """The landmarks of two spheres, the proposal, and what is said."""
    console = Console(record=True, width=300)
    config = compose_config(["task=pair_map", *words])
    _, ids, found = given_or_proposed(landmarks, shapes or meshes(), domain, config, console)
    return [x.tolist() for x in ids], found, console.export_text()


def proposed_with(margin, monkeypatch, *words, score=2.0):
    answers(monkeypatch, margin, score)
    return take("auto", *words)


def test_a_sure_proposal_is_taken_in_the_numbers_of_the_files(monkeypatch, tmp_path):
    ids, found, said = proposed_with(0.5, monkeypatch)
    # the second file has a vertex more in front
    assert ids == [[0, 1, 2, 3], [11, 12, 13, 14]]
    assert "WARNING" not in said and "0.500" in said
    assert found.warning is None and found.figures == {"landmarks_sure": True}
    (tmp_path / "landmarks.json").write_text(found.to_json())
    assert list(read_pairs(tmp_path / "landmarks.json")) == ids


def test_an_unsure_one_is_a_warning_or_an_error(monkeypatch):
    for margin, score in ((0.01, 2.0), (0.5, 3.5)):
        _, _, said = proposed_with(margin, monkeypatch, score=score)
        assert "WARNING" in said
        with pytest.raises(NsmError) as refused:
            proposed_with(margin, monkeypatch, "proposal.strict=true", score=score)
        assert (refused.value.kind, refused.value.key) == ("unsure_landmarks", "proposal.strict")
    proposed_with(0.5, monkeypatch, "proposal.strict=true")


def test_the_second_best_is_one_flag_away(monkeypatch):
    ids, found, _ = proposed_with(0.01, monkeypatch, "proposal.alternative=1")
    assert ids[0] == [20, 21, 22, 23]
    assert '"source": [0, 1, 2, 3]' in found.to_json()  # the best is kept among alternatives
    _, second, said = proposed_with(0.5, monkeypatch, "proposal.alternative=1")
    assert second.figures == {"landmarks_sure": False}  # however sure the best is
    assert second.warning.plain in said and "proposal.alternative=0" in said
    with pytest.raises(NsmError) as refused:
        proposed_with(0.01, monkeypatch, "proposal.alternative=2")
    assert (refused.value.kind, refused.value.key) == ("out_of_range", "proposal.alternative")


def test_only_meshes_are_proposed_for():
    with pytest.raises(NsmError) as refused:
        take("auto", shapes=[meshes()[0], SimpleNamespace()])
    assert (refused.value.kind, refused.value.key) == ("wrong_type", "landmarks")


def test_closed_meshes_without_landmarks_have_some_proposed(monkeypatch):
    answers(monkeypatch, 0.5)
    assert take(None)[1] and take("auto", domain=DISC)[1]
    assert take(None, domain=DISC)[1] is None
    assert take([])[1] is None
    assert take(None, shapes=[meshes()[0], results(2).neural[0]])[1] is None


@pytest.mark.parametrize("count", [1, 4, 8])
def test_one_to_eight_given_landmarks_are_kept_and_completed(count, monkeypatch):
    answers(monkeypatch, 0.5)
    pairs = [[100 + k, 201 + k] for k in range(count)]
    ids, found, said = take(pairs)
    assert ids[0] == [*range(100, 100 + count), 0, 1, 2, 3]
    assert ids[1] == [*range(201, 201 + count), 11, 12, 13, 14]
    assert f"{count} given" in said and f'"given": {count}' in found.to_json()
    alone = ([[p[0] for p in pairs], [p[1] for p in pairs]], None)
    assert take(pairs, "proposal.complete=false")[:2] == alone
    assert take(pairs, domain=DISC)[:2] == alone


def test_unsure_ones_complete_fewer_than_four_only(monkeypatch):
    answers(monkeypatch, 0.01)
    pairs = [[100 + k, 201 + k] for k in range(4)]
    ids, found, said = take(pairs)
    assert (len(ids[0]), found) == (4, None) and "4 given are kept" in said
    ids, _, said = take(pairs[:3])
    assert len(ids[0]) == 7 and "WARNING" in said
    assert len(take(pairs, "proposal.alternative=1")[0][0]) == 8  # who asks for it has it


def test_nine_given_landmarks_are_complete(monkeypatch):
    answers(monkeypatch, 0.5)
    pairs = [[100 + k, 201 + k] for k in range(9)]
    ids, found, said = take(pairs)
    assert (len(ids[0]), found, said.strip()) == (9, None, "")


def test_nothing_is_said_where_nothing_is_left_to_complete(monkeypatch):
    def all_given(source, target, given):
        return Proposal([Hypothesis(given, 2.0, True, None)], np.inf)

    monkeypatch.setattr(proposed_landmarks, "proposed", all_given)
    ids, found, said = take([[100 + k, 201 + k] for k in range(5)])
    assert (len(ids[0]), found, "proposed" in said) == (5, None, False)


PLACES = [[[0, 0.2, 0.3, 0.5], [7, 0.5, 0.5, 0.0]], [[4, 0.1, 0.1, 0.8], [9, 0.0, 1.0, 0.0]]]


@pytest.mark.parametrize("domain", [ORBIFOLD, DISC])
def test_places_in_triangles_are_kept_as_they_are(domain):
    given = {"source": PLACES[0], "target": PLACES[1]}
    ball = trimesh.creation.icosphere(subdivisions=2)
    files = [Mesh(name, np.array(ball.vertices), np.array(ball.faces)) for name in "ab"]
    console, config = Console(quiet=True), compose_config(["task=pair_map"])
    config.proposal.complete = False
    shapes, ids, _ = given_or_proposed(given, files, domain, config, console)
    for file, shape, of_one, places in zip(files, shapes, ids, PLACES, strict=True):
        wanted = [np.array(w) @ file.vertices[file.faces[int(f)]] for f, *w in places]
        assert np.allclose(shape.vertices[of_one], wanted)
        assert np.array_equal(shape.vertices[: len(file.vertices)], file.vertices)
        surface = Surface.load((shape.vertices, shape.faces), domain=domain)
        found = surface.at(surface.preimages(of_one.tolist()))
        assert np.allclose(found / surface.scale + surface.center, wanted, atol=1e-6)
    _, nearest, _ = given_or_proposed(given, files, domain, config, console, exact=False)
    for file, of_one, places in zip(files, nearest, PLACES, strict=True):
        corners = [file.faces[int(f)][np.argmax(w)] for f, *w in places]
        assert of_one[0] == corners[0] and of_one[1] in file.faces[int(places[1][0])]
    bad = {"source": [[0, 0.2, 0.3, 0.9]], "target": [[4, 0.1, 0.1, 0.8]]}
    with pytest.raises(NsmError) as refused:
        given_or_proposed(bad, files, domain, config, console)
    assert (refused.value.kind, refused.value.key) == ("not_on_surface", "a")


def test_places_are_written_as_places(monkeypatch, tmp_path):
    answers(monkeypatch, 0.5)
    ids, found, said = take({"source": PLACES[0], "target": [50, 60]})
    count = len(meshes()[0].vertices)
    assert ids[0][:2] == [count, count + 1] and "become 2 vertices" in said
    (tmp_path / "landmarks.json").write_text(found.to_json())
    source, target = read_pairs(tmp_path / "landmarks.json")
    assert target == ids[1] and source[:2].tolist() == PLACES[0]
    faces = meshes()[0].faces
    for (face, *weights), vertex in zip(source[2:], ids[0][2:], strict=True):
        assert faces[int(face)][np.argmax(weights)] == vertex and max(weights) == 1


def test_landmarks_of_a_collection(monkeypatch, tmp_path):
    rows = [np.arange(15).reshape(5, 3), np.arange(15).reshape(5, 3)[::-1]]
    found = CollectionProposal(rows, [1.0, 1.3], 0.3, 0, True)
    monkeypatch.setattr(proposed_landmarks, "proposed_for_all", lambda *_: found)
    shapes = [*meshes(), meshes()[0]]
    ids, proposal, said = take(None, shapes=shapes)
    assert ids == [[0, 3, 6, 9, 12], [2, 5, 8, 11, 14], [2, 5, 8, 11, 14]]
    assert "5 proposed, sure" in said
    (tmp_path / "landmarks.json").write_text(proposal.to_json())
    assert read_collection(tmp_path / "landmarks.json") == ids


def test_shapes_without_a_proposal_are_mapped_without_landmarks_unless_asked(monkeypatch):
    def nothing(*_):
        raise NsmError("no tips", kind="no_proposal", key="landmarks")

    monkeypatch.setattr(proposed_landmarks, "proposed", nothing)
    ids, found, said = take(None)
    assert (ids, found) == ([[], []], None) and "no tips" in said
    for landmarks, words in (("auto", []), (None, ["proposal.strict=true"])):
        with pytest.raises(NsmError):
            take(landmarks, *words)


def test_a_proposal_is_for_the_part_that_is_kept(monkeypatch):
    answers(monkeypatch, 0.5)
    vertices, faces = sphere()
    both = (
        np.concatenate([vertices, 0.3 * vertices + 5]),
        np.concatenate([faces, faces + len(vertices)]),
    )
    shapes = [meshes()[0], Mesh("both", *both)]
    with pytest.raises(NsmError) as refused:
        take("auto", shapes=shapes)
    assert refused.value.kind == "disconnected"
    assert take("auto", "surface.parts=largest", shapes=shapes)[1] is not None


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
    kept = json.loads((tmp_path / "run" / "metrics.json").read_text())
    warnings = [line for line in kept["warnings"] if "NOT SURE" in line]
    assert len(warnings) == 1 and kept["metrics"]["landmarks_sure"] is False
    assert run.stdout.count(warnings[0]) == 2  # before the training, and after the figures
    source, target = read_pairs(tmp_path / "run" / "landmarks.json")
    assert (source, target) == ([0, 1, 2, 3], [10, 11, 12, 13])


def test_the_search_is_told_while_it_lasts(monkeypatch):
    answers(monkeypatch, 0.5)
    known = proposed_landmarks.proposed

    def slow(*arguments):
        time.sleep(0.3)
        return known(*arguments)

    monkeypatch.setattr(proposed_landmarks, "proposed", slow)
    monkeypatch.setattr(stages, "QUIET_FOR", 0.05)
    _, _, said = take("auto")
    assert said.count("proposing landmarks of a, b") >= 2


def test_two_rings_have_landmarks_proposed_and_up_to_four_completed(monkeypatch):
    answers(monkeypatch, 0.5)
    rings = [Mesh(name, *torus(24, 12)) for name in "ab"]
    assert take(None, shapes=rings, domain=TORUS)[1]
    assert take("auto", shapes=rings, domain=DISC)[1]
    assert take(None, shapes=rings, domain=DISC)[1] is None
    pairs = [[100 + k, 101 + k] for k in range(5)]
    assert take(pairs[:4], shapes=rings, domain=TORUS)[1].given == 4
    assert take(pairs, shapes=rings, domain=TORUS)[1] is None
    three = [*rings, Mesh("c", *torus(24, 12))]
    assert take(None, shapes=three, domain=TORUS)[1] is None
    assert take(None, shapes=[rings[0], meshes()[0]], domain=DISC)[1] is None


@pytest.mark.parametrize("given", [0, 1])
def test_a_proposal_without_common_seams_is_left_out(given, monkeypatch):
    ids = [np.arange(4), np.arange(4) + 10]
    found = ProposedLandmarks([np.stack(ids, axis=1)], [1.0], 0.1, False, given, 0)
    seen = []

    def surfaces(config, shapes, landmarks, console, *_):
        seen.append([one.tolist() for one in landmarks])
        if len(landmarks[0]) > given:
            raise NsmError("no seams", kind="no_common_seam", key="landmarks")
        return ["phi", "psi"]

    monkeypatch.setattr(pair_map, "given_or_proposed", lambda *_, **__: (meshes(), ids, found))
    monkeypatch.setattr(pair_map, "check_landmarks", lambda *_: None)
    monkeypatch.setattr(pair_map, "closed_parts", lambda shapes, *_: shapes)
    monkeypatch.setattr(pair_map, "neural_surfaces", surfaces)
    task = pair_map.PairMapTask("pair_map")
    console = Console(record=True, width=200)
    task.setup(compose_config(["task=pair_map", "domain=disc"]), console)
    used = []
    monkeypatch.setattr(task, "use", lambda *what: used.append(what))
    first, second = ((mesh.vertices, mesh.faces) for mesh in meshes())
    task.prepare(Given(source=first, target=second))
    kept = [list(range(given)), list(range(10, 10 + given))]
    assert seen == [[ids[0].tolist(), ids[1].tolist()], kept]
    assert task.proposed is None and "no landmarks are proposed: no seams" in console.export_text()
    assert used[0][:2] == ("phi", "psi")
    assert [one.tolist() for one in used[0][2]] == kept
