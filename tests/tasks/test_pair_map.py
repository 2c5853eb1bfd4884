"""PairMap and CollectionMap: known maps are found, constraints hold, runs resume."""

import itertools
import math

import numpy as np
import pytest
import torch

from nsm.data import Samples
from nsm.domains import Disc
from nsm.energies import SymmetricDirichlet, first_fundamental_form, symmetric_dirichlet
from nsm.maps import Rotated, build_analytic
from nsm.surfaces.shapes import ring_mesh
from nsm.tasks import CollectionMap, PairMap
from nsm.tasks import fold_barrier as fold_barrier_module
from nsm.tasks import terms as tasks_terms
from nsm.tasks.fold_barrier import FoldBarrier
from nsm.tasks.initial_rotation import landmark_rotation, least_distorting_rotation

SETTINGS = {
    "map": {
        "width": 16,
        "depth": 1,
    },
    "activation": {"_target_": "nsm.maps.activations.Softplus", "beta": 10.0},
    "encoding": {"_target_": "nsm.maps.encodings.Identity"},
    "optimizer": {"_target_": "torch.optim.Adam", "lr": 3e-3},
    "scheduler": {"_target_": "nsm.tasks.schedules.Constant"},
    "max_steps": 200,
    "domain": Disc(),
    "energy": SymmetricDirichlet(),
}
WEIGHTS = {"injectivity": 100.0, "boundary": 1e3, "landmarks": 10.0, "seam": 0.0, "triangles": 0.0}
CONSTRAINTS = {
    "boundary": "exact",
    "landmarks": "augmented",
    "multiplier_every": 10,
    "ramp": 0.0,
}
NONE = torch.zeros(0, 2)
_POINTS, _FACES = ring_mesh(8)
MESH = (torch.as_tensor(_POINTS, dtype=torch.float32), torch.as_tensor(_FACES))


def settings(changes):
    """The settings with changes: of the constraints, of the weights, or of the rest."""
    constraints = {key: changes.pop(key, value) for key, value in CONSTRAINTS.items()}
    more = ("pairs", "triangles_from")
    constraints |= {key: changes.pop(key) for key in more if key in changes}
    weights = {**WEIGHTS, **changes.pop("weights", {})}
    return {**SETTINGS, "loss_weights": weights, "constraints": constraints, **changes}


def samples(n=256, seed=0):
    g = torch.Generator().manual_seed(seed)
    r, t = torch.rand(n, generator=g).sqrt(), 2 * torch.pi * torch.rand(n, generator=g)
    return torch.stack([r * t.cos(), r * t.sin()], dim=1)


def quiet(kind):
    """Made without a trainer: it logs nothing."""

    def make(**arguments):
        module = kind(**arguments)
        module.log_every = 10**9
        return module

    return make


def start(rotation):
    return Rotated(torch.nn.Identity(), rotation)


def pair(phi, psi, points=NONE, targets=NONE, rotation=None, mesh=MESH, **changes):
    torch.manual_seed(0)
    return quiet(PairMap)(
        **settings(changes),
        points=points,
        targets=targets,
        seam=torch.zeros(0, 2, 2),
        start=start(torch.eye(2) if rotation is None else rotation),
        mesh=mesh,
        diagonal=1.0,
        phi=phi,
        psi=psi,
    )


def surface(name, **parameters):
    return build_analytic({"name": name, **parameters})


def optimise(module, steps, every=10):
    """Plain optimisation without a trainer: the module's own steps."""
    optimiser = torch.optim.Adam(module.map.parameters(), lr=3e-3)
    for step in range(steps):
        optimiser.zero_grad()
        batch = samples(seed=step)
        x = batch if isinstance(module, CollectionMap) else Batch(batch)
        module.training_step(x, step).backward()
        optimiser.step()
        if step % every == every - 1:  # without a trainer the module cannot count its steps
            module.on_train_batch_end(None, x, step)
    return module


def Batch(uv):
    return Samples(uv, torch.zeros(len(uv), 3), torch.zeros(len(uv), 3))


def evaluated(module, x):
    """Distortion, det J_h and h at points of Ω."""
    batch = x if isinstance(module, CollectionMap) else Batch(x)
    distortion, evaluation = module._evaluated(batch)
    return distortion, evaluation.determinant, evaluation.image


def test_the_identity_between_equal_surfaces_is_the_minimum():
    module = pair(surface("saddle"), surface("saddle"))
    energy, determinant, image = evaluated(module, samples())
    assert energy.mean.item() == pytest.approx(2 + 2 / 1.01, rel=1e-5)
    assert (determinant == 1).all() and (image == samples()).all()


def test_the_distortion_of_caps_hardly_counts_but_they_must_not_fold():
    """Triangles of the quadrature are those of the part; the barrier against folds has all."""
    caps = torch.zeros(len(MESH[1]), dtype=torch.bool)
    caps[:3] = True
    changes = {"caps": caps, "constraints": {**CONSTRAINTS, "triangles_from": 0.0}}
    module = pair(surface("saddle"), surface("saddle"), **changes)
    assert torch.equal(module.quadrature.faces, MESH[1][~caps])
    assert torch.equal(module.caps.quadrature.faces, MESH[1][caps])
    assert len(module.fold_barrier.faces) == len(MESH[1])
    loss = module.training_step(Batch(samples()), 0)
    least = 2 + 2 / 1.01
    assert loss.item() == pytest.approx(least + 0.01 * math.log1p(least), rel=1e-4)


def test_a_triangle_without_area_in_the_domain_leaves_loss_and_gradient_finite():
    points, faces = MESH
    flat = torch.tensor([[0.0, 0.0], [0.25, 0.0], [0.5, 0.0]])
    mesh = (torch.cat([points, flat]), torch.cat([faces, len(points) + torch.arange(3)[None]]))
    changes = {"mesh": mesh, "constraints": {**CONSTRAINTS, "triangles_from": 0.0}}
    module = pair(surface("saddle"), surface("saddle"), **changes)
    loss = module.training_step(Batch(samples()), 0)
    loss.backward()
    assert loss.item() == pytest.approx(2 + 2 / 1.01, rel=1e-4)
    gradients = [p.grad for p in module.parameters() if p.grad is not None]
    assert gradients and all(torch.isfinite(g).all() for g in gradients)


def test_an_isometry_between_different_surfaces_is_the_minimum():
    # a cylinder patch unrolls onto the plane without stretch
    module = pair(surface("cylinder"), surface("plane"))
    energy, _, _ = evaluated(module, samples())
    assert energy.mean.item() == pytest.approx(2 + 2 / 1.01, rel=1e-4)


def test_a_rotation_of_the_source_is_undone_by_the_start():
    angle = 0.7
    c, s = np.cos(angle), np.sin(angle)
    turn = torch.tensor([[c, -s], [s, c]], dtype=torch.float32)
    p = samples(5)
    assert (landmark_rotation("disc", p, p @ turn.T) - turn).abs().max() < 1e-6
    quarter = landmark_rotation("square", p, p @ torch.tensor([[0.1, 1.0], [-1.0, 0.1]]))
    assert (quarter.abs().round() - quarter.abs()).abs().max() < 1e-6


def test_without_landmarks_the_least_distorting_rotation_is_taken():
    # a saddle turned by a quarter turns to its mirror image: only multiples of a half fit
    bent = surface("graph", z="0.8*u*u")
    across = surface("graph", z="0.8*v*v")
    turn = least_distorting_rotation("disc", bent, across, samples(512))
    assert abs(abs(turn[0, 1].item()) - 1) < 1e-6
    assert (least_distorting_rotation("square", bent, bent, samples(512))[0, 0].abs() - 1) < 1e-6


def test_optimisation_lowers_distortion_and_meets_landmarks():
    points = torch.tensor([[0.3, 0.1], [-0.4, 0.2]])
    targets = torch.tensor([[0.25, 0.2], [-0.45, 0.1]])
    module = optimise(pair(surface("plane"), surface("sphere_cap"), points, targets), 250)
    assert (module(points) - targets).norm(dim=1).max() < 5e-3
    energy, determinant, _ = evaluated(module, samples(2000))
    assert energy.mean.item() < 4.5 and (determinant > 0).all()


def test_a_landmark_that_stays_far_off_is_let_go_where_steps_at_triangles_begin(monkeypatch):
    points = torch.tensor([[0.3, 0.0], [-0.4, 0.2]])
    targets = points + torch.tensor([[0.02, 0.0], [0.5, 0.0]])  # h is the identity
    changes = {"triangles_from": 0.5, "max_steps": 10}
    module = pair(surface("plane"), surface("plane"), points, targets, **changes)
    module.seam = torch.zeros(1, 2, 2)  # without one, nothing bars the way
    step = [4]
    monkeypatch.setattr(PairMap, "global_step", property(lambda self: step[0]))
    module.multipliers += 1.0
    module.on_train_batch_end(None, None, 0)
    assert module.held.tolist() == [True, True]
    step[0] = 5
    module.on_train_batch_end(None, None, 0)
    assert module.held.tolist() == [True, False]
    assert module.multipliers[1].tolist() == [0, 0]
    before = module.multipliers[0].clone()
    C, multipliers = module.landmark_terms()
    off = (targets - points)[0]
    assert C.item() == pytest.approx(float(off @ off), rel=1e-4)
    assert multipliers.item() == pytest.approx(-float(before @ off), rel=1e-4)
    error = module.landmark_error()  # still told
    assert error[1] > 10 * error[0] > 0
    earlier = {"microbatches": 1, "state_dict": {}}  # of a version that let none go
    module.on_load_checkpoint(earlier)
    assert earlier["state_dict"]["lost"].shape == (2,)


def test_multipliers_meet_landmarks_better_than_a_fixed_weight():
    points, targets = torch.tensor([[0.3, 0.1]]), torch.tensor([[0.0, 0.1]])
    off = {}
    for kind in ("augmented", "fixed"):
        module = pair(
            surface("plane"),
            surface("plane"),
            points,
            targets,
            landmarks=kind,
            weights={"landmarks": 10.0},
        )
        off[kind] = (optimise(module, 250)(points) - targets).norm().item()
    assert off["augmented"] < 0.3 * off["fixed"]


def test_the_penalty_boundary_pulls_the_image_back():
    points, targets = torch.tensor([[0.9, 0.0]]), torch.tensor([[1.2, 0.0]])
    loose = pair(
        surface("plane"),
        surface("plane"),
        points,
        targets,
        boundary="penalty",
        landmarks="fixed",
        weights={"boundary": 0.0},
    )
    held = pair(
        surface("plane"),
        surface("plane"),
        points,
        targets,
        boundary="penalty",
        landmarks="fixed",
        weights={"boundary": 1e3},
    )
    reach = [
        optimise(m, 150)(m.boundary_samples).norm(dim=1).sub(1).abs().max().item()
        for m in (loose, held)
    ]
    assert reach[1] < 0.3 * reach[0]


def test_samples_outside_leave_the_distortion_but_are_pulled():
    module = pair(surface("plane"), surface("plane"), boundary="penalty")
    outside = Batch(1.5 * samples())
    loss = module.training_step(outside, 0)
    assert torch.isfinite(loss) and loss > 4


def test_the_ramp_moves_targets_from_the_start_to_their_place():
    module = pair(surface("plane"), surface("plane"), ramp=0.5)
    assert module.ramp == 0.0
    assert pair(surface("plane"), surface("plane")).ramp == 1.0


def test_the_seam_term_draws_both_copies_together():
    seam = torch.tensor([[[1.0, 0.0], [0.0, 1.0]]])
    torch.manual_seed(0)
    module = quiet(PairMap)(
        **settings({"weights": {"seam": 10.0}}),
        points=NONE,
        targets=NONE,
        seam=seam,
        start=start(torch.eye(2)),
        mesh=MESH,
        diagonal=1.0,
        phi=surface("plane"),
        psi=surface("plane"),
    )
    before = module._seam_gap().item()
    assert before == pytest.approx(2.0, rel=1e-5)
    assert optimise(module, 60)._seam_gap().item() < before


@pytest.mark.parametrize(
    "changes", [{"boundary": "soft"}, {"landmarks": "soft"}, {"ramp": 2.0}, {"multiplier_every": 0}]
)
def test_settings_that_are_not_known_are_refused(changes):
    with pytest.raises(ValueError):
        pair(surface("plane"), surface("plane"), **changes)


def collection(names, points=NONE, targets=None, seam=None, **changes):
    torch.manual_seed(0)
    k = len(names)
    return quiet(CollectionMap)(
        **settings(changes),
        points=points,
        targets=torch.zeros(k, 0, 2) if targets is None else targets,
        seam=torch.zeros(0, 2, 2) if seam is None else seam,
        starts=[start(torch.eye(2))] * k,
        mesh=MESH,
        meshes=[MESH] * k,
        diagonals=[1.0] * k,
        phis=[surface(n) for n in names],
    )


def test_a_collection_of_equal_surfaces_starts_at_the_minimum():
    energy, determinant, _ = evaluated(collection(["saddle"] * 3), samples())
    assert energy.mean.item() == pytest.approx(2 + 2 / 1.01, rel=1e-5)
    assert determinant.shape == (3, 256)


def test_a_collection_of_two_is_the_mean_of_both_pair_maps():
    module = collection(["plane", "sphere_cap"])
    x = samples(4096)
    energy, _, _ = evaluated(module, x)
    forth, _, _ = evaluated(pair(surface("plane"), surface("sphere_cap")), x)
    cap = surface("sphere_cap")
    area = torch.linalg.det((j := cap.value_and_jacobian(x)[1]).transpose(1, 2) @ j).sqrt()
    # samples are uniform on the plane: back counts by the cap's area
    with torch.no_grad():
        a = first_fundamental_form(cap.value_and_jacobian(x)[1])
        b = first_fundamental_form(surface("plane").value_and_jacobian(x)[1])
        back = (area * symmetric_dirichlet(a, b)).sum() / area.sum()
        plane = torch.ones_like(area)
        weight = plane / ((plane + area) / 2)
        forth_weighted = (weight * symmetric_dirichlet(b, a)).sum() / weight.sum()
        cap_weight = area / ((plane + area) / 2)
        back_weighted = (cap_weight * symmetric_dirichlet(a, b)).sum() / cap_weight.sum()
    assert energy.mean.item() == pytest.approx(
        0.5 * (forth_weighted + back_weighted).item(), rel=1e-4
    )
    assert forth.mean.item() == pytest.approx(forth_weighted.item(), rel=0.05)
    assert back.item() == pytest.approx(back_weighted.item(), rel=0.05)


def turned(names, number, **changes):
    """A collection at the triangles of its meshes, where the map of one surface has its turn."""
    module = collection(names, triangles_from=0.0, **changes)
    maps = list(module.map)
    module._turn = module.quadrature.turn(number, maps, module.quadrature.corners(maps))
    return module


def test_at_triangles_maps_take_turns():
    module = collection(["plane", "saddle", "sphere_cap"], triangles_from=0.0)
    found = [(h, module._turn.number) for h in module.turns()]
    assert found == [(h, i) for i, h in enumerate(module.map)] and module._turn is None
    at_samples = collection(["plane"] * 3)
    assert list(at_samples.turns()) == [at_samples.map]


def test_in_its_turn_a_map_has_the_energy_of_its_pairs_at_the_sources_triangles():
    names = ["plane", "saddle", "sphere_cap"]
    module = turned(names, 1)
    own = module._evaluated(samples())[0].mean.item()
    both = [(0, 1), (2, 1), (1, 0), (1, 2)]
    found = []
    for ends in both:
        f = pair(
            *(surface(names[n]) for n in ends), constraints={**CONSTRAINTS, "triangles_from": 0.0}
        )
        found.append(f._evaluated(Batch(samples()))[0].mean.item())
    assert own == pytest.approx(sum(found) / 4, rel=1e-4)


def test_moved_triangles_are_those_that_the_map_makes_of_the_meshes():
    """Taken back by each h_i as it is, the corners lead to the meshes' own vertices."""
    module = collection(["plane", "saddle", "sphere_cap"], triangles_from=0.0)
    torch.manual_seed(1)
    with torch.no_grad():
        for p in module.map.parameters():
            p += 0.02 * torch.randn_like(p)
    for number, h in enumerate(module.map):
        maps = list(module.map)
        turn = module.quadrature.turn(number, maps, module.quadrature.corners(maps))
        own = turn.of[turn.inward :].unique()
        corners = turn.some.uv[turn.some.faces[own]]
        torch.testing.assert_close(h(corners), MESH[0][MESH[1]], atol=1e-5, rtol=0)
    assert float((module(MESH[0])[0] - MESH[0]).detach().abs().max()) > 1e-3


def test_a_turn_s_loss_has_the_gradient_of_the_whole_loss():
    """k/2 times the part of L at the same triangles: by finite differences of the pairs."""
    module = turned(["plane", "saddle", "sphere_cap"], 2)
    module.training_step(samples(), 0).backward()
    p = next(p for p in module.map[2].parameters() if p.grad is not None and p.grad.abs().max() > 0)
    place = int(p.grad.abs().argmax())
    ends = []
    for change in (1e-2, -2e-2):
        with torch.no_grad():
            p.view(-1)[place] += change
        ends.append(module._evaluated(samples())[0].mean.item())
    assert (ends[0] - ends[1]) / 2e-2 == pytest.approx(p.grad.view(-1)[place].item(), rel=0.05)
    others = [q.grad for h in module.map[:2] for q in h.parameters()]
    assert all(g is None or float(g.abs().max()) == 0 for g in others)


def test_a_landmark_that_a_map_misses_is_a_corner_of_the_triangles():
    points, number = MESH[0][5:6] + 0.01, 1
    targets = MESH[0][5:6].expand(3, 1, 2).clone()
    targets[2] = torch.nan
    module = turned(["plane", "saddle", "sphere_cap"], number, points=points, targets=targets)
    uv = module._turn.some.uv
    assert ((uv - points).norm(dim=1) < 1e-6).sum() == 2  # of the two surfaces that have it
    assert ((uv - MESH[0][5]).norm(dim=1) < 1e-6).sum() == 1


def test_the_paper_sums_over_all_ordered_pairs():
    names, x = ["plane", "saddle", "sphere_cap"], samples(512)
    points, targets = torch.tensor([[0.2, 0.1]]), torch.tensor([[[0.3, 0.1]]] * 3)
    given = {"points": points, "targets": targets, "landmarks": "fixed"}
    losses = {
        of: collection(names, **given, pairs=of).training_step(x, 0) for of in ("sum", "mean")
    }
    metrics = [first_fundamental_form(surface(n).value_and_jacobian(x)[1]) for n in names]
    area = torch.stack([torch.linalg.det(a).sqrt() for a in metrics])
    total = 0.0  # h is the identity; a pair is weighted by its source's area
    for i, j in itertools.permutations(range(3), 2):
        weight = area[i] / area.mean(dim=0)
        total += (weight * symmetric_dirichlet(metrics[i], metrics[j])).sum() / weight.sum()
    missed = 10.0 * 3 * 0.1**2  # λ_C Σ‖h(P) - Q‖² of three surfaces
    assert losses["sum"].item() == pytest.approx(float(total) + missed, rel=1e-5)
    assert losses["mean"].item() == pytest.approx(float(total) / 6 + 4 / 3 * missed, rel=1e-5)


def test_a_collection_meets_its_landmarks_on_every_surface():
    points = torch.tensor([[0.2, 0.1]])
    targets = torch.tensor([[[0.3, 0.1]], [[0.1, 0.1]], [[0.2, 0.2]]])
    module = collection(["plane", "saddle", "sphere_cap"], points, targets)
    optimise(module, 200, every=20)
    assert (module(points) - targets).norm(dim=2).max() < 0.01


def test_a_large_mesh_is_gone_through_in_parts(monkeypatch):
    def folding(x):
        asked.append(len(x))
        return torch.stack([x[:, 0] - 0.9 * torch.sin(3 * x[:, 0]), x[:, 1]], dim=1)

    asked: list[int] = []
    uv, faces = ring_mesh(24)
    mesh = torch.as_tensor(uv, dtype=torch.float32), torch.as_tensor(faces)
    whole, parts = FoldBarrier(*mesh), FoldBarrier(*mesh)
    whole(folding, 0)
    monkeypatch.setattr(fold_barrier_module, "_LOOK", 600)
    asked.clear()
    for step in range(0, 25 * 6, 25):  # once through all
        parts(folding, step)
    assert max(asked) < len(uv) / 1.5
    folds = [w(folding, 1) for w in (whole, parts)]
    torch.testing.assert_close(*folds)


def test_the_weakest_triangles_are_those_that_fold():
    weakest = FoldBarrier(*MESH)

    def folding(x):  # the right end is folded back
        return torch.where(x[:, :1] > 0.8, torch.stack([1.6 - x[:, 0], x[:, 1]], dim=1), x)

    assert weakest(folding, 0) > 0.05
    corners = MESH[0][MESH[1][weakest.chosen]]
    assert corners[:5, :, 0].max(dim=1).values.min() > 0.8
    assert weakest(lambda x: x, 25) == 0


def test_folded_triangles_are_unfolded():
    torch.manual_seed(0)
    values = torch.tensor([[0.05, 0.0]]).repeat(len(MESH[0]), 1) + MESH[0]
    centre = MESH[0].norm(dim=1) == 0
    moved = torch.where(centre[:, None], values + 0.14, values).requires_grad_()
    weakest, optimiser = FoldBarrier(*MESH), torch.optim.Adam([moved], lr=0.01)
    start = weakest(lambda x: moved if len(x) == len(moved) else moved[nearest(x)], 0)
    assert start > 0
    for step in range(400):
        optimiser.zero_grad()
        weakest(lambda x: moved if len(x) == len(moved) else moved[nearest(x)], step).backward()
        optimiser.step()
    assert weakest(lambda x: moved if len(x) == len(moved) else moved[nearest(x)], 0) < 1e-3


def nearest(x):
    return torch.cdist(x, MESH[0]).argmin(dim=1)


def test_a_collection_held_by_penalties_pulls_strays_back():
    module = collection(["plane", "saddle", "plane"], boundary="penalty")
    assert torch.isfinite(module.training_step(1.5 * samples(), 0))
    inner = evaluated(module, samples())[0].mean
    mixed = evaluated(module, torch.cat([samples(), 2 + samples()]))[0].mean
    assert mixed.item() == pytest.approx(inner.item(), rel=1e-5)


def test_the_loss_of_a_collection_does_not_depend_on_how_many_surfaces_it_has():
    """The same surface k times, each map off the identity, so that all terms have a part in it."""
    points = torch.tensor([[0.2, 0.1]])
    seam = torch.tensor([[[1.0, 0.0], [0.0, 1.0]]])
    gradients, losses = [], []
    for k in (3, 4, 6):
        module = collection(["saddle"] * k, points, torch.zeros(k, 1, 2), weights=FULL, seam=seam)
        module.multipliers += 0.5
        for h in module.map:
            for parameter in h.parameters():
                parameter.data = torch.full_like(parameter, 0.03)
        loss = module.training_step(samples(), 0)
        loss.backward()
        # each surface's share of the gradient falls as 1/k
        flat = [p.grad.flatten() for p in module.map[0].parameters()]
        gradients.append(k * torch.cat(flat))
        losses.append(loss.detach())
    for gradient, loss in zip(gradients[1:], losses[1:], strict=True):
        torch.testing.assert_close(loss, losses[0])
        torch.testing.assert_close(gradient, gradients[0], rtol=1e-3, atol=1e-4)


FULL = {"seam": 10.0, "triangles": 10.0}


class Centre:
    """A term of a user: the image is pulled to the middle of Ω."""

    def __call__(self, evaluation):
        return (evaluation.image**2).sum(dim=-1)


@pytest.mark.parametrize("kind", ["pair", "collection"])
def test_a_users_own_term_is_added_with_its_weight(kind, monkeypatch):
    monkeypatch.setattr(tasks_terms, "made", lambda settings: Centre())
    terms = {"centre": {"_target_": "mine.Centre", "weight": 0.5}}

    def losses(**changes):
        if kind == "pair":
            module, x = pair(surface("plane"), surface("saddle"), **changes), Batch(samples())
        else:
            module, x = collection(["plane", "saddle", "cone"], **changes), samples()
        return module.training_step(x, 0)

    expected = 0.5 * (samples() ** 2).sum(dim=1).mean()
    torch.testing.assert_close(losses(loss_terms=terms) - losses(), expected, rtol=1e-3, atol=1e-4)
