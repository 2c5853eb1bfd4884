"""The cost of a training step, and the time of a training to a given error.

Variants that are compared run in turn, round by round; results are medians. On a CPU, time is the
CPU time of the process (all its threads), which other programs disturb little; on a GPU it is
wall-clock time, synchronized. The GPU is used where there is one.

    python benchmarks/speed.py [--mesh FILE] [--seconds LIMIT] [--threads N]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from types import SimpleNamespace
from typing import Any

import numpy as np
import published_step as published
import scale
import torch
import waiting
from omegaconf import DictConfig
from torch import Tensor, nn
from training import module_of, samples_of

from nsm.config import compose_config
from nsm.data import Samples, SurfaceData
from nsm.domains import Surface
from nsm.domains.surface import as_it_lies
from nsm.energies.distortion import LEAST_SYMMETRIC_DIRICHLET
from nsm.energies.overfit import normal, position
from nsm.maps import NeuralMap, batched
from nsm.maps.encodings import Identity
from nsm.results import NeuralSurface, atomic_write
from nsm.surfaces.shapes import ring_mesh
from nsm.tasks.compiling import Compiled
from nsm.tasks.fold_barrier import FoldBarrier

RESULTS = Path(__file__).parent / "results"
PAGE = Path(__file__).parent.parent / "docs" / "performance.md"
TASKS = ("overfit", "param", "pair_map", "collection_map")
SETTINGS = ("paper", "default")
ERRORS = (1.0, 0.5, 0.2, 0.1)  # RMS in percent of the diagonal
SHARES = (0.5, 0.8, 0.9, 0.95)  # of the decrease from the domain's distortion to the least found
SURFACES = 3
BATCHED = (2, 4, 16)  # surfaces in one batch
NEVER = 10**12  # steps
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")

Step = Callable[[], None]


def clock() -> float:
    if DEVICE.type == "cuda":
        torch.cuda.synchronize()
        return time.perf_counter()
    return time.process_time()


def in_turn(sides: dict[str, Step], rounds: int) -> dict[str, float]:
    """Median seconds of each variant; they take turns, after one round that does not count."""
    taken: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(rounds + 1):
        for name, step in sides.items():
            start = clock()
            step()
            taken[name].append(clock() - start)
    return {name: median(values[1:]) for name, values in taken.items()}


def dome(rings: int = 30, height: float = 0.5) -> Surface:
    """A bulging disc."""
    uv, faces = ring_mesh(rings)
    vertices = np.column_stack([uv, height * (1 - (uv**2).sum(axis=1))])
    return as_it_lies("dome", vertices, faces, uv, "disc")


def config_of(task: str, settings: str) -> DictConfig:
    """The task's configuration."""
    overrides = [f"task={task}", "seed=0"]
    if settings == "paper":
        overrides += ["experiment=paper"]
    elif task in _SPLINES:
        overrides += ["experiment=adam"]
    return compose_config(overrides)


def frozen_surface(settings: str, surface: Surface) -> NeuralSurface:
    """An untrained network in place of the neural surface: it costs as much."""
    module = module_of(config_of("overfit", settings), surface)
    return NeuralSurface(surface, module.map.eval().requires_grad_(False))


def ready(data: SurfaceData) -> SurfaceData:
    """The samples, which are then drawn on the device."""
    place = SimpleNamespace(root_device=DEVICE)
    data.trainer = SimpleNamespace(strategy=place, global_rank=0, world_size=1)  # type: ignore[assignment]
    data.setup()
    return data


def task_steps(task: str, settings: str, k: int = SURFACES) -> tuple[Step, Step]:
    """Loss and gradient of one step of the same networks: ours, and the published recipe's."""
    config, surface = config_of(task, settings), dome()
    batch = ready(samples_of(config, surface)).batch(0)
    phis = [frozen_surface(settings, surface) for _ in range(k)] if task != "overfit" else []
    none = [np.zeros(0, dtype=np.int64)] * k
    module: Any
    if task == "overfit":
        module = module_of(config, surface).to(DEVICE)

        def theirs() -> Tensor:
            return published.overfit(module.map, *batch)

    elif task == "param":
        module = module_of(config, phis[0]).to(DEVICE)

        def theirs() -> Tensor:
            return published.param(phis[0].map, module.map, batch.uv)

    elif task == "pair_map":
        module = module_of(config, phis[0], phis[1], none[:2]).to(DEVICE)
        boundary = module.domain.boundary_samples().to(DEVICE)

        def theirs() -> Tensor:
            return published.pair_map(phis[0].map, phis[1].map, module.map, batch.uv, boundary)

    else:
        module = module_of(config, phis, none).to(DEVICE)
        boundary = module.domain.boundary_samples().to(DEVICE)

        def theirs() -> Tensor:
            return published.collection_map(
                [p.map for p in phis], list(module.map), batch.uv, boundary
            )

    for phi in phis:  # after the preparation, which is the CPU's
        phi.map.to(DEVICE)
    module.log_every = NEVER  # there is no logger here
    given = batch.uv if task == "collection_map" else batch

    def step(loss: Callable[[], Tensor]) -> Step:
        def run() -> None:
            module.zero_grad()
            loss().backward()

        return run

    return step(lambda: module.training_step(given, 0)), step(theirs)


def products(net: NeuralMap, batch: int) -> tuple[Step, float]:
    """The matrix products of value, Jacobian and gradients of a network, and their flops."""
    layers = [m for m in net.modules() if isinstance(m, nn.Linear)]
    triples = [
        tuple(torch.randn(shape, device=DEVICE) for shape in shapes)
        for shapes in (
            ((3 * batch, m.in_features), tuple(m.weight.shape), (3 * batch, m.out_features))
            for m in layers
        )
    ]
    bare = isinstance(net.encoding, Identity)

    def run() -> None:
        for a, w, _ in triples:
            torch.mm(a, w.t())
        for k, (a, w, g) in enumerate(triples):
            torch.mm(g.t(), a)
            if k or not bare:  # the points themselves need no gradient
                torch.mm(g, w)

    count = sum(a.shape[0] * w.numel() for a, w, _ in triples)
    skipped = triples[0][0].shape[0] * triples[0][1].numel() if bare else 0
    return run, 2.0 * (3 * count - skipped)


def peak_rate() -> float:
    """Flops per second of one large matrix product, the best of several."""
    side = 2048 if DEVICE.type == "cpu" else 8192
    a, b = torch.randn(side, side, device=DEVICE), torch.randn(side, side, device=DEVICE)
    best = float("inf")
    for _ in range(6):
        start = clock()
        torch.mm(a, b)
        best = min(best, clock() - start)
    return 2.0 * side**3 / best


def costs(rounds: int) -> dict[str, Any]:
    """(a) A step of each task, and of the published recipe."""
    found = {}
    for settings in SETTINGS:
        for task in TASKS:
            ours, theirs = task_steps(task, settings)
            taken = in_turn({"nsm": ours, "published": theirs}, rounds)
            found[f"{task}/{settings}"] = {
                **{f"{k}_milliseconds": 1e3 * v for k, v in taken.items()},
                "ratio": taken["published"] / taken["nsm"],
            }
            print(f"{task}/{settings}", found[f"{task}/{settings}"], flush=True)
    return found


def share_of_peak(rounds: int) -> dict[str, Any]:
    """(b) A step of overfitting, its matrix products alone, and the machine's best rate."""
    found: dict[str, Any] = {"peak_gflops": peak_rate() / 1e9}
    for settings in SETTINGS:
        config = config_of("overfit", settings)
        net = module_of(config, dome()).map
        bare, flops = products(net, config.data.batch_size)
        ours = task_steps("overfit", settings)[0]
        taken = in_turn({"nsm": ours, "products": bare}, rounds)
        found[settings] = {
            "step_milliseconds": 1e3 * taken["nsm"],
            "products_milliseconds": 1e3 * taken["products"],
            "step_over_products": taken["nsm"] / taken["products"],
            "share_of_peak": flops / taken["nsm"] / 1e9 / found["peak_gflops"],
            "products_share_of_peak": flops / taken["products"] / 1e9 / found["peak_gflops"],
        }
        print(settings, found[settings], flush=True)
    return found


def growth(rounds: int) -> dict[str, Any]:
    """(d) Milliseconds of a step as one size changes."""

    def of(net: NeuralMap, batch: int) -> Step:
        net, x = net.to(DEVICE), 2 * torch.rand(batch, 2, device=DEVICE) - 1

        def run() -> None:
            net.zero_grad()
            value, jacobian = net.value_and_jacobian(x)
            (value.square().mean() + jacobian.square().mean()).backward()

        return run

    def made(width: int = 128, depth: int = 3) -> NeuralMap:
        return NeuralMap(3, width=width, depth=depth, block="plain")

    sides = {f"batch/{n}": of(made(), n) for n in (256, 1024, 4096, 16384)}
    sides |= {f"width/{n}": of(made(width=n), 1024) for n in (32, 64, 128, 256, 512)}
    sides |= {f"depth/{n}": of(made(depth=n), 1024) for n in (1, 2, 4, 8, 16)}
    sides |= {f"surfaces/{k}": task_steps("collection_map", "paper", k)[0] for k in (2, 4, 8)}
    found = {key: 1e3 * value for key, value in in_turn(sides, rounds).items()}
    for rings in (30, 100, 300, 580):
        surface = dome(rings)
        data = ready(SurfaceData(surface, batch_size=1024))
        uv, faces = torch.as_tensor(surface.uv, dtype=torch.float32), torch.as_tensor(surface.faces)
        barrier, h = FoldBarrier(uv, faces).to(DEVICE), made().to(DEVICE)
        planar = lambda x, h=h: h(x)[:, :2]  # noqa: E731

        def fifty(data: Any = data, barrier: Any = barrier, planar: Any = planar) -> None:
            for step in range(50):  # the barrier looks at all triangles twice
                data.batch(step)
                barrier(planar, step).backward()

        found[f"mesh/{len(surface.faces)}"] = 1e3 * in_turn({"": fifty}, 2)[""] / 50
    return found


def _held_out(data: SurfaceData) -> Samples:
    parts = list(data.val_dataloader())
    return Samples(*(torch.cat(part) for part in zip(*parts, strict=True)))


def _trained(module: Any, data: SurfaceData, config: DictConfig, look: Any, limit: float) -> float:
    """Train to the last step, the limit, or until ``look`` says so; returns the seconds without
    those of ``look``."""
    module.log_every = NEVER
    parts = module.configure_optimizers()
    optimizer, schedule = parts["optimizer"], parts["lr_scheduler"]["scheduler"]
    clip, spent, seen, step = config.trainer.gradient_clip, 0.0, 0.0, 0
    module._step = 0
    while step < config.trainer.max_steps and spent < limit:
        start = clock()
        optimizer.zero_grad()
        module.training_step(data.batch(step), 0).backward()
        if clip:
            nn.utils.clip_grad_norm_(module.map.parameters(), clip)
        optimizer.step()
        schedule.step()
        step += 1
        module._step = step
        spent += clock() - start
        if look is not None and spent - seen > max(0.25, 0.02 * spent):
            seen = spent
            if look(spent):
                break
    return spent


def times(mesh: str, limit: float) -> dict[str, Any]:
    """(c) Seconds to given held-out errors, and then to given held-out distortions, including the
    initialization by least squares.

    The default's schedule ends with its last step, so that it is trained for several lengths and
    the first good one counts. The published schedule has no end and is measured as it goes.
    """
    surface = Surface.load(mesh)
    found: dict[str, Any] = {"surface": surface.name, "limit_seconds": limit, "overfit": {}}

    def task(name: str, settings: str, steps: int | None, phi: Any = None) -> tuple[Any, ...]:
        config = config_of(name, settings)
        if steps is not None:
            config.trainer.max_steps = steps
        if phi is not None:
            phi.map.cpu()  # a map is prepared there
        start = clock()
        module = _stepping(module_of(config, phi or surface).to(DEVICE))
        built = clock() - start
        return config, module, ready(samples_of(config, surface)), built

    def rms(module: Any, held: Samples) -> float:
        with torch.no_grad():
            squared = position(module.map(held.uv), held.points).mean()
        return 100 * float(squared.sqrt()) / surface.bounding_box_diagonal

    curves: dict[str, list[tuple[float, float]]] = {"default": [], "paper": []}
    phi = None
    for steps in (1, 125, 250, 500, 1000):
        config, module, data, built = task("overfit", "default", steps)
        spent = built + _trained(module, data, config, None, limit)
        curves["default"].append((spent, rms(module, _held_out(data))))
        phi = NeuralSurface(surface, module.map.eval().requires_grad_(False))
    config, module, data, _ = task("overfit", "paper", None)
    held = _held_out(data)
    _trained(module, data, config, _follow(curves["paper"], lambda: rms(module, held)), limit)
    for settings, curve in curves.items():
        found["overfit"][settings] = {
            "seconds_to_percent": {str(e): _first(curve, e) for e in ERRORS},
            "best_percent": min(value for _, value in curve),
        }

    def distortion(module: Any, held: Samples) -> float:
        with torch.no_grad():
            return float(module._evaluated(held)[0].mean)

    curves = {"default": [], "paper": []}
    for steps in (25, 50, 100, 200, 400):
        config, module, data, _ = task("param", "default", steps, phi)
        held = _held_out(data)
        before = distortion(module, held)
        spent = _trained(module, data, config, None, limit)
        curves["default"].append((spent, distortion(module, held)))
    config, module, data, _ = task("param", "paper", None, phi)
    _trained(
        module, data, config, _follow(curves["paper"], lambda: distortion(module, held)), limit
    )
    least = min(value for curve in curves.values() for _, value in curve)
    wanted = [before + share * (least - before) for share in SHARES]
    found["param"] = {"distortion_of_domain": before, "least_distortion": least}
    for settings, curve in curves.items():
        found["param"][settings] = {
            "seconds_to_distortion": {f"{w:.4g}": _first(curve, w) for w in wanted},
            "best_distortion": min(value for _, value in curve),
        }
    print(json.dumps(found, indent=1), flush=True)
    return found


def _stepping(module: Any) -> Any:
    """The module with its own count of steps, since there is no trainer."""
    cls = type(module)
    counted = property(lambda self: getattr(self, "_step", 0))
    module.__class__ = type(cls.__name__, (cls,), {"global_step": counted})
    return module


def _follow(curve: list[tuple[float, float]], value: Callable[[], float]) -> Any:
    def look(seconds: float) -> bool:
        curve.append((seconds, value()))
        return False

    return look


def _first(curve: list[tuple[float, float]], wanted: float) -> float | None:
    return min((seconds for seconds, value in curve if value <= wanted), default=None)


def memory() -> dict[str, Any]:
    """(e) MiB that a step stores for its backward pass, without parameters; on a GPU, its peak."""
    found: dict[str, Any] = {}
    for task in TASKS:
        both = zip(("nsm", "published"), task_steps(task, "paper"), strict=True)
        found[task] = {f"{side}_mib": _kept(step) for side, step in both}
        found[task]["ratio"] = found[task]["published_mib"] / found[task]["nsm_mib"]
    return found


def _kept(step: Step) -> float:
    if DEVICE.type == "cuda":
        step()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        step()
        return (torch.cuda.max_memory_allocated() - before) / 2**20
    storages: dict[int, int] = {}

    def pack(tensor: Tensor) -> Tensor:
        if not isinstance(tensor, nn.Parameter):
            storage = tensor.untyped_storage()
            storages[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        step()
    return sum(storages.values()) / 2**20


def batches(rounds: int) -> dict[str, Any]:
    """Milliseconds of a step of several surfaces, one after the other and in one batch, and of
    one surface with compiled evaluation."""
    config, surface = config_of("overfit", "default"), dome()
    batch = ready(samples_of(config, surface)).batch(0)
    modules = [module_of(config, surface).to(DEVICE) for _ in range(max(BATCHED))]

    def step(one: Callable[[Tensor], tuple[Tensor, Tensor]], uv: Tensor) -> Step:
        def run() -> None:
            value, jacobian = one(uv)
            loss = position(value, batch.points.expand_as(value)).mean()
            turn = normal(jacobian, batch.normals.expand_as(value)).mean()
            (loss + config.loss_weights.normal * turn).backward()

        return run

    found: dict[str, Any] = {}
    for k in BATCHED:
        nets = [m.map for m in modules[:k]]
        singly = [step(net.value_and_jacobian, batch.uv) for net in nets]

        def one_by_one(steps: list[Step] = singly) -> None:
            for one in steps:
                one()

        at_once = step(batched(nets).value_and_jacobian, batch.uv.expand(k, -1, -1))
        taken = in_turn({"one_by_one": one_by_one, "batched": at_once}, rounds)
        found[str(k)] = {f"{name}_milliseconds": 1e3 * v for name, v in taken.items()}
        found[str(k)]["ratio"] = taken["one_by_one"] / taken["batched"]
    net = modules[0].map
    compiled, kind = Compiled(print), "compiled" if DEVICE.type == "cpu" else "recorded"
    sides = {
        "as_it_is": step(net.value_and_jacobian, batch.uv),
        kind: step(lambda uv: compiled(net.value_and_jacobian, uv), batch.uv),  # type: ignore[arg-type,return-value]
    }
    taken = in_turn(sides, 10 * rounds)
    found["compiled"] = {f"{name}_milliseconds": 1e3 * v for name, v in taken.items()}
    found["compiled"]["ratio"] = taken["as_it_is"] / taken[kind]
    print(json.dumps(found, indent=1), flush=True)
    return found


def loops(rounds: int) -> dict[str, Any]:
    """(f) Steps of maps, as they are taken by default."""
    found = {}
    for task in ("pair_map", "collection_map"):
        found[task] = _loop(task, rounds)
        print(task, found[task], flush=True)
    return found


def _loop(task: str, rounds: int) -> dict[str, float]:
    """Milliseconds of a step of Adam and of a quasi-Newton step, and how many evaluations of the
    loss the latter makes."""
    config, k = compose_config([f"task={task}", "seed=0"]), 2 if task == "pair_map" else SURFACES
    phis = [frozen_surface("default", dome(height=0.3 + 0.2 * n)) for n in range(k)]
    none = [np.zeros(0, dtype=np.int64)] * k
    given: Any = (*phis, none) if task == "pair_map" else (phis, none)
    module = _stepping(module_of(config, *given).to(DEVICE))
    module.log_every = NEVER
    samples = ready(samples_of(config, dome())).batch(0)
    batch = samples if task == "pair_map" else samples.uv
    optimizer = module.configure_optimizers()["optimizer"]
    coefficients = [field.coefficients for field in optimizer.fields]
    starts = [c.detach().clone() for c in coefficients]
    count, evaluated = optimizer.state[coefficients[0]], 0

    def closure() -> Tensor:
        nonlocal evaluated
        evaluated += 1
        optimizer.zero_grad()
        loss: Tensor = module.training_step(batch, 0)
        loss.backward()
        return loss

    def at(step: int) -> Step:
        def run() -> None:
            with torch.no_grad():
                for c, start in zip(coefficients, starts, strict=True):
                    c.copy_(start)
            module._step = count["step"] = step
            optimizer.step(closure)

        return run

    last = int(optimizer.newton_from) + 1
    taken = in_turn({"adam": at(0), "quasi_newton": at(last)}, rounds)
    found = {f"{name}_milliseconds": 1e3 * v for name, v in taken.items()}
    return {**found, "evaluations": evaluated / (rounds + 1) - 1}


def _named(key: str) -> str:
    """The task and settings of a step, as ``config_of`` takes them."""
    task, settings = key.split("/")
    network = task in _SPLINES and settings == "default"
    return f"{task}, {'experiment=adam' if network else settings}"


_ON_A_GPU = [
    "No GPU was there. Nothing of nsm has run on CUDA, and no figure of these pages is of a GPU; "
    "`make bench-speed` measures there what this page has, and writes "
    "`benchmarks/results/speed-NAME.json`. Instead, tests train on a pretended accelerator "
    "(`tests/pretend_device.py`). Its tensors hold numbers, but no operation takes them together "
    "with those of the CPU, numpy cannot read them, and copies are counted. So it is known that:",
    "",
    "- Steps of all tasks, by default and with the paper's settings, and a whole run of a "
    "collection end there as on the CPU, up to rounding.",
    "- A step of Adam of a map copies nothing between host and device. Lightning's hooks add one "
    "number: whether loss and gradient are finite.",
    "- A quasi-Newton step keeps coefficients, gradients, L-BFGS pairs and the metric on the "
    "device. The host waits for the loss of each evaluation, that same number, and two numbers in "
    "each iteration.",
    "- Splines of a collection are read, and take Adam's steps, in one batch.",
    "",
    "The metric is a dense Cholesky factor there: on 128 × 128 cells 16,900 rows, or 8,192 on an "
    "orbifold, and 2.3 or 0.5 GB for each component of h, two or three. Double precision is slow "
    "on most consumer cards; there, factors may take longer than the sparse ones on the CPU. "
    "The host still prepares and certifies, inverts the maps of a collection once in each "
    "quasi-Newton step, and finds which sides of a free boundary are near in each evaluation. "
    "Not covered: `trainer.compile` (CUDA graphs), several GPUs, surfaces given by formulas, and "
    "all that depends on CUDA's own kernels.",
]


def page(results: dict[str, Any]) -> str:
    """The results as the page docs/performance.md."""
    on = results["machine"]
    lines = [
        "# Performance",
        "",
        f"`make bench-speed` measured these figures on {on['device']} with {on['threads']} "
        f"thread(s), torch {on['torch']} and float32. Times are {on['clock']}, medians of "
        "variants that ran in turn.",
    ]
    if "costs" in results:
        lines += [
            "",
            "## A step of each task",
            "",
            "Loss and gradient, compared with a plain restatement of the published recipe (one "
            "`autograd.grad` per output, batched SVD and explicit inverse) for the same networks "
            f"and batch. The collection has {SURFACES} surfaces. Maps take "
            "quasi-Newton steps on a spline by default, which the recipe has no counterpart of: "
            "the network of `experiment=adam` takes their place.",
            "",
            "| task, settings | published, ms | nsm, ms | speed-up |",
            "|---|---|---|---|",
        ]
        lines += [
            f"| {_named(key)} | {v['published_milliseconds']:.1f} | "
            f"{v['nsm_milliseconds']:.1f} | {v['ratio']:.2f} |"
            for key, v in results["costs"].items()
        ]
    if "peak" in results:
        lines += [
            "",
            "## Share of the machine's peak",
            "",
            "A step of overfitting, compared with its matrix products alone, forward and backward, "
            "and with the rate of one large product "
            f"({results['peak']['peak_gflops']:.0f} GFLOP/s).",
            "",
            "| settings | step, ms | products, ms | step / products | share of peak | "
            "products' share |",
            "|---|---|---|---|---|---|",
        ]
        lines += [
            f"| {s} | {v['step_milliseconds']:.1f} | {v['products_milliseconds']:.1f} | "
            f"{v['step_over_products']:.2f} | {100 * v['share_of_peak']:.0f} % | "
            f"{100 * v['products_share_of_peak']:.0f} % |"
            for s, v in results["peak"].items()
            if s in SETTINGS
        ]
    if "times" in results:
        t = results["times"]
        limit = f"not within {t['limit_seconds']:.0f} s"

        def cells(found: dict[str, float | None]) -> str:
            return " | ".join(limit if s is None else f"{s:.1f} s" for s in found.values())

        for title, of, by, best in (
            ("RMS error, % of the diagonal", "overfit", "seconds_to_percent", "best_percent"),
            ("distortion", "param", "seconds_to_distortion", "best_distortion"),
        ):
            wanted = t[of]["default"][by]
            lines += [
                "",
                f"## Time to a given {title}",
                "",
                f"task={of} on {t['surface']}, on held-out points."
                + (
                    f" The domain itself has distortion {t['param']['distortion_of_domain']:.3f}; "
                    f"{LEAST_SYMMETRIC_DIRICHLET} is the least that is possible. Samples cannot "
                    "flip; triangles of flattenings that do are [counted](maps.md#measurements)."
                    if of == "param"
                    else ""
                ),
                "",
                "| settings | " + " | ".join(wanted) + " | best seen |",
                "|---" * (len(wanted) + 2) + "|",
                *(f"| {s} | {cells(t[of][s][by])} | {t[of][s][best]:.3f} |" for s in SETTINGS),
            ]
    if "growth" in results:
        lines += ["", "## How a step's cost grows", "", "| what | milliseconds |", "|---|---|"]
        groups: dict[str, list[str]] = {}
        for key, value in results["growth"].items():
            what, size = key.split("/")
            groups.setdefault(what, []).append(f"{size}: {value:.1f}")
        names = {
            "batch": "batch, width 128, 3 layers",
            "width": "width, batch 1,024, 3 layers",
            "depth": "layers, batch 1,024, width 128",
            "surfaces": "surfaces of a collection, settings of the paper",
            "mesh": "triangles: samples and the fold barrier",
        }
        lines += [f"| {names[k]} | {', '.join(v)} |" for k, v in groups.items()]
    if "batches" in results:
        b = results["batches"]
        lines += [
            "",
            "## Several surfaces in one batch",
            "",
            "Loss and gradient of overfitting with the default settings.",
            "",
            "| surfaces | one by one, ms | batched, ms | speed-up |",
            "|---|---|---|---|",
        ]
        lines += [
            f"| {k} | {b[str(k)]['one_by_one_milliseconds']:.1f} | "
            f"{b[str(k)]['batched_milliseconds']:.1f} | {b[str(k)]['ratio']:.2f} |"
            for k in BATCHED
        ]
        lines += [
            "",
            "With compiled evaluation (`trainer.compile=true`) a step is "
            f"{b['compiled']['ratio']:.2f} times as fast.",
        ]
    if "loops" in results:
        lines += [
            "",
            "## The steps of a map",
            "",
            "A step of Adam on splines of 128 × 128 cells, and a quasi-Newton step at triangles of "
            f"domes, 5,400 of each. The collection has {SURFACES} surfaces, whose maps take "
            "turns in a quasi-Newton step.",
            "",
            "| task | Adam, ms | quasi-Newton, ms | evaluations of the loss in it |",
            "|---|---|---|---|",
        ]
        lines += [
            f"| {task} | {v['adam_milliseconds']:.1f} | {v['quasi_newton_milliseconds']:.0f} | "
            f"{v['evaluations']:.0f} |"
            for task, v in results["loops"].items()
        ]
    lines += ["", "## On a GPU", "", *_ON_A_GPU]
    if "memory" in results:
        lines += [
            "",
            "## Memory",
            "",
            "What a step with the paper's settings stores for its backward pass, in MiB.",
            "",
            "| task | published | nsm | ratio |",
            "|---|---|---|---|",
        ]
        lines += [
            f"| {k} | {v['published_mib']:.0f} | {v['nsm_mib']:.0f} | {v['ratio']:.1f} |"
            for k, v in results["memory"].items()
        ]
    if waiting.RESULTS.exists():
        lines += waiting.section(json.loads(waiting.RESULTS.read_text()))
    if scale.RESULTS.exists():
        lines += scale.section(json.loads(scale.RESULTS.read_text()))
    return "\n".join(lines) + "\n"


def write_page() -> None:
    """Write docs/performance.md from the stored results."""
    PAGE.write_text(page(json.loads((RESULTS / "speed.json").read_text())))


# tasks whose default trains a spline, by steps that the recipe has no counterpart of
_SPLINES = ("param", "pair_map", "collection_map")
PARTS = ("costs", "peak", "growth", "batches", "loops", "memory", "times")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mesh", default="terrain", help="mesh for the time to an error")
    parser.add_argument("--seconds", type=float, default=120.0, help="limit of one training")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--parts", nargs="+", choices=PARTS, help="all by default")
    parser.add_argument(
        "--output", type=Path, help="folder of the JSON file; then no page is written"
    )
    arguments = parser.parse_args()
    parts = arguments.parts or PARTS
    torch.set_num_threads(arguments.threads)
    cuda = DEVICE.type == "cuda"
    device = torch.cuda.get_device_name() if cuda else f"{os.cpu_count()} CPU cores"
    name = f"speed-{device.lower().replace(' ', '-')}.json" if cuda else "speed.json"
    output = (arguments.output or RESULTS) / name
    machine = {
        "device": device,
        "processor": platform.machine(),
        "torch": torch.__version__,
        "threads": arguments.threads,
        "clock": "wall-clock time" if cuda else "CPU time of the process",
    }
    make: dict[str, Callable[[], dict[str, Any]]] = {
        "costs": lambda: costs(arguments.rounds),
        "peak": lambda: share_of_peak(arguments.rounds),
        "growth": lambda: growth(arguments.rounds),
        "batches": lambda: batches(arguments.rounds),
        "loops": lambda: loops(arguments.rounds),
        "memory": memory,
        "times": lambda: times(arguments.mesh, arguments.seconds),
    }
    for part in parts:  # stored one by one: an interrupted run keeps what it has
        found = make[part]()
        results = json.loads(output.read_text()) if output.exists() else {}
        results = {**results, "machine": machine, part: found}
        output.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(output, (json.dumps(results, indent=1) + "\n").encode())
        if arguments.output is None and not cuda:
            write_page()
    print(page(results))


if __name__ == "__main__":
    main()
