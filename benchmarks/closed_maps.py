"""Maps of closed surfaces, on the disc and without a seam, side by side: one JSON for each case.

Figures that are there are kept, so that an interrupted run continues where it stopped:

    python benchmarks/closed_maps.py --meshes FOLDER [--only CASE ...] [--again WAY ...]

A pair is mapped with the default training and with experiment=fast, first all on their closed
domain. There they are mapped with four quasi-Newton steps too, settled or not (``short``), and with
experiment=adam, the default before those steps, and with experiment=preview. Some are mapped once
more with four times the coefficients and all steps: ``longest``, which shows how far the others are
from the least distortion. Seconds are the CPU time of a map on one thread, from trained surfaces,
with the check of its landmarks, figures and certificate. The four animals are prepared together, as
for a collection, other pairs as pairs.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import platform
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import mean
from typing import Any
from unittest import mock

import numpy as np
import torch
import trimesh
from maps import ANIMALS, FROM_START, table, timed

import nsm

RESULTS = Path(__file__).parent / "results" / "closed_maps"
FOUR = tuple(name[-3:] for name in ANIMALS)
FURTHER = (("385", "391"), ("392", "383"), ("395", "397"), ("398", "400"))
KEPT = (
    "symmetric_dirichlet_median",
    "symmetric_dirichlet_mean",
    "symmetric_dirichlet_p95",
    "flipped_percent",
    "landmark_error_mean_percent",
    "landmark_error_max_percent",
    "seam_gap_mean_percent",
    "seam_gap_max_percent",
    "certified",
    "flipped_before_repair_percent",
    "start_symmetric_dirichlet_median",
    "start_flipped_percent",
)
WAYS: dict[str, list[str]] = {
    "default": [],
    "fast": ["experiment=fast"],
    "short": ["trainer.max_steps=254", "constraints.triangles_from=0.984"],
    "adam": ["experiment=adam"],
    "preview": ["experiment=preview"],
    "longest": ["map.cells=256", "constraints.settled=0"],
}
LONGEST = ("384-388", "393-384", "393-388", "398-400", "busts 302-314", "cat-horse")
OF_COLLECTION = ("default", "adam")
ON_CLOSED_DOMAINS = ("short", "adam", "preview")
START = ["trainer.max_steps=1", "artefacts=false", "certification.repair=false"]  # fills the cache


def figures(f: Any, seconds: float, training: float) -> dict[str, Any]:
    found = {key: f.metrics[key] for key in KEPT if key in f.metrics}
    return {"map_seconds": round(seconds, 1), "training_seconds": round(training, 2), **found}


@contextmanager
def watched_training() -> Iterator[list[float]]:
    """The CPU seconds of each training that a run makes, without what goes before and after it."""
    from nsm.pipeline import runner

    spent: list[float] = []
    inner = runner.trained

    def watched(*args: Any, **kwargs: Any) -> Any:
        started = time.process_time()
        try:
            return inner(*args, **kwargs)
        finally:
            spent.append(time.process_time() - started)

    with mock.patch.object(runner, "trained", watched):
        yield spent


def pair(
    source: Any, target: Any, landmarks: Any, domain: str, ways: Sequence[str]
) -> dict[str, Any]:
    """Maps of two files, or of two ready surfaces, by the way they are trained."""
    if not isinstance(source, nsm.NeuralSurface):
        start = nsm.map_pair(
            source, target, landmarks, overrides=[*START, f"domain={domain}"], progress=False
        )
        source, target, landmarks = start.source, start.target, start.landmarks.tolist()
    result = {}
    for way in ways:
        settings = [*WAYS[way], "artefacts=false"]
        with watched_training() as training:
            f, seconds = timed(
                functools.partial(
                    nsm.map_pair, source, target, landmarks, overrides=settings, progress=False
                )
            )
        result[way] = figures(f, seconds, sum(training))
    return result


@functools.cache
def prepared(files: tuple[str, ...], marks: tuple[str, ...], domain: str) -> Any:
    """Surfaces that are prepared together, with their landmarks."""
    settings = [*START, f"domain={domain}"]
    start = nsm.map_collection(list(files), list(marks), overrides=settings, progress=False)
    return start.surfaces, start.landmarks


def of_collection(
    files: Sequence[str], marks: Sequence[str], i: int, j: int, domain: str, ways: Sequence[str]
) -> Any:
    """A pair of surfaces that were prepared together with others."""
    surfaces, landmarks = prepared(tuple(files), tuple(marks), domain)
    return pair(surfaces[i], surfaces[j], landmarks[:, [i, j]].tolist(), domain, ways)


def collection(
    files: Sequence[str], marks: Sequence[str], domain: str, ways: Sequence[str]
) -> dict[str, Any]:
    """The collection, by the way it is trained: figures of the pairs, and the time of all."""
    settings = [f"domain={domain}", "artefacts=false", "phi.steps=null"]
    nsm.map_collection(files, marks, overrides=[*settings, START[0]], progress=False)
    result = {}
    for way in ways:
        group, seconds = timed(
            functools.partial(
                nsm.map_collection, files, marks, overrides=[*WAYS[way], *settings], progress=False
            )
        )
        result[way] = {"map_seconds": round(seconds, 1), **_of_pairs(group.metrics)}
    return result


def _of_pairs(metrics: dict[str, Any]) -> dict[str, Any]:
    """Means over the pairs of a collection, and the worst errors."""
    every = metrics["pairs"].values()
    worst = {
        key: max(of[key] for of in every)
        for key in ("landmark_error_max_percent", "seam_gap_max_percent")
        if all(key in of for of in every)
    }
    averages = {key: mean(of[key] for of in every) for key in (*KEPT[:4], *KEPT[-3:])}
    cycles = {key: value for key, value in metrics.items() if key.startswith("cycle")}
    return {**averages, **worst, **cycles, "certified": metrics["certified"]}


def rings(folder: Path) -> tuple[list[str], list[list[int]]]:
    """Two closed surfaces of genus 1 that are bent differently, with eight common landmarks."""
    mesh = trimesh.creation.torus(
        major_radius=1.0, minor_radius=0.35, major_sections=96, minor_sections=40
    )
    points = np.asarray(mesh.vertices)
    angle = np.arctan2(points[:, 1], points[:, 0])
    first = points * (1 + 0.25 * np.sin(3 * angle))[:, None]
    second = points * [1.5, 0.9, 1.0]
    second[:, 2] += 0.5 * np.sin(2 * angle)
    files = []
    for name, vertices in (("wavy_ring", first), ("bent_ring", second)):
        files.append(str(folder / f"{name}.obj"))
        trimesh.Trimesh(vertices, mesh.faces, process=False).export(files[-1])
    marks = np.linspace(0, len(points) - 1, 9)[:-1].astype(int).tolist()
    return files, [[v, v] for v in marks]


Case = tuple[str, Callable[[str, Sequence[str]], dict[str, Any]]]


def cases(meshes: Path, scratch: Path) -> dict[str, Case]:
    """For each name the closed domain, and what is done on a domain in some ways."""
    marks = meshes / "landmarks"
    result: dict[str, Case] = {}

    def add(name: str, files: Sequence[str], landmarks: Any, domain: str = "orbifold") -> None:
        result[name] = (domain, lambda on, ways: pair(*files, landmarks, on, ways))

    four, points = shapes(meshes, FOUR, "vts")
    for i, j in itertools.permutations(range(len(FOUR)), 2):
        name = f"{FOUR[i]}-{FOUR[j]}"
        result[name] = (  # type: ignore[assignment]
            "orbifold",
            lambda on, ways, i=i, j=j: of_collection(four, points, i, j, on, ways),
        )
    both = [str(meshes / f"cat_horse-{k}.obj") for k in (0, 1)]
    texts = [str(marks / f"cat_horse-{k}.txt") for k in (0, 1)]
    add("cat-horse", both, texts)
    add("busts 302-314", *shapes(meshes, ("302", "314"), "vts"))
    add("plane-bird 61-248", *shapes(meshes, ("61", "248"), "pinned"))
    add("genus 1", *rings(scratch), "torus")
    add("horse-cat", both[::-1], texts[::-1])
    for ends in FURTHER:
        add("-".join(ends), *shapes(meshes, ends, "vts"))
    result["collection"] = ("orbifold", lambda on, ways: collection(four, points, on, ways))
    return result


def shapes(meshes: Path, numbers: Sequence[str], ending: str) -> tuple[list[str], list[str]]:
    """The files of shapes by their numbers, and of their landmarks."""
    files = [str(meshes / f"shrec07-{n}.off") for n in numbers]
    return files, [str(meshes / "landmarks" / f"shrec07-{n}.{ending}") for n in numbers]


COLUMNS = {
    **FROM_START,
    "landmark_error_max_percent": "landmark error, largest %",
    "seam_gap_max_percent": "torn by at most %",
    "map_seconds": "seconds",
    "training_seconds": "of training",
}


RATIOS = (
    "symmetric_dirichlet_median",
    "symmetric_dirichlet_mean",
    "symmetric_dirichlet_p95",
    "map_seconds",
)


def tables() -> str:
    """All results as Markdown; the distortion is symmetric Dirichlet."""
    results = [json.loads(f.read_text()) for f in sorted(RESULTS.glob("*.json"))]
    rows = []
    for found in results:
        for domain in ("disc", found["closed_domain"]):
            for way, of in sorted(found[domain].items(), key=lambda one: list(WAYS).index(one[0])):
                row = [f"{of[key]:.2f}" if key in of else "–" for key in COLUMNS]
                name = "" if rows and rows[-1][-1] == found["case"] else found["case"]
                rows.append(
                    [name, domain, way, *row, "yes" if of["certified"] else "no", found["case"]]
                )
    shown = table(
        ["map", "domain", "training", *COLUMNS.values(), "certified"], [row[:-1] for row in rows]
    )
    pairs = [found for found in results if found["case"] != "collection"]
    groups = {"all": pairs, "genus 0": [p for p in pairs if p["closed_domain"] == "orbifold"]}
    compared = {
        "Closed domain over disc": (("closed", "default"), ("disc", "default")),
        "Fast over default, closed domains": (("closed", "fast"), ("closed", "default")),
        "Fast over default, disc": (("disc", "fast"), ("disc", "default")),
        "Default over Adam, closed domains": (("closed", "default"), ("closed", "adam")),
        "Short over Adam, closed domains": (("closed", "short"), ("closed", "adam")),
        "Preview over default, closed domains": (("closed", "preview"), ("closed", "default")),
        "Longest over default, closed domains": (("closed", "longest"), ("closed", "default")),
        "Longest over default, disc": (("disc", "longest"), ("disc", "default")),
        "Longest, closed domain over disc": (("closed", "longest"), ("disc", "longest")),
    }
    ratios = []
    for label, ends in compared.items():
        for what, chosen in groups.items():
            every = ([_figures_of(found, *end) for end in ends] for found in chosen)
            both = [pair for pair in every if all(pair)]  # others are not measured yet
            if not both:
                continue
            every_ratio = [[one[key] / other[key] for one, other in both] for key in RATIOS]
            shown_means = [f"{mean(of):.3f}" for of in every_ratio]
            ratios.append([f"{label}, {len(both)} pairs ({what})", *shown_means])
            if ends[0][1] == "preview" and what == "all":
                ratios.append([f"{label}, the largest", *(f"{max(of):.3f}" for of in every_ratio)])
    heads = ["mean of the ratios", *(COLUMNS[key] for key in RATIOS)]
    return f"{shown}\n\n{table(heads, ratios)}\n"


def _figures_of(found: dict[str, Any], domain: str, way: str) -> dict[str, Any]:
    on = found[found["closed_domain"] if domain == "closed" else domain]
    figures: dict[str, Any] = on.get(way, {})
    return figures


def measure(
    name: str,
    closed: str,
    domain: str,
    run: Callable[[str, Sequence[str]], dict[str, Any]],
    again: Sequence[str] = (),
) -> None:
    """What is missing of a case on a domain, or only some ways again, into its file."""
    file = RESULTS / f"{name.replace(' ', '_')}.json"
    about = {"torch": torch.__version__, "machine": platform.machine()}
    found: dict[str, Any] = {"case": name, "closed_domain": closed, **about}
    if file.exists():
        found = json.loads(file.read_text())
    known = found.setdefault(domain, {})
    every = OF_COLLECTION if name == "collection" else tuple(WAYS)
    every = tuple(way for way in every if way != "longest" or name in LONGEST)
    if domain != closed:
        every = tuple(way for way in every if way not in ON_CLOSED_DOMAINS)
    wanted = [way for way in every if (way in again if again else way not in known)]
    if wanted:
        print(name, domain, *wanted, flush=True)
        known |= run(domain, wanted)
        file.write_text(json.dumps(found, indent=2) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--meshes", type=Path, default=Path("../shared/meshes"))
    parser.add_argument("--only", nargs="*", help="cases to run; all by default")
    parser.add_argument("--again", nargs="*", default=(), choices=WAYS, help="measure these again")
    arguments = parser.parse_args()
    if not arguments.meshes.is_dir():
        parser.error(f"{arguments.meshes}: no such folder; give one with --meshes")
    RESULTS.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        for on in ("closed", "disc"):
            for name, (closed, run) in cases(arguments.meshes, Path(scratch)).items():
                if not arguments.only or name in arguments.only:
                    measure(name, closed, closed if on == "closed" else on, run, arguments.again)
    text = tables()
    (RESULTS.parent / "closed_maps.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
