"""How often landmarks are doubted before a training: right ones, and ones with a fault.

    python benchmarks/landmark_check.py --meshes FOLDER

Random ordered pairs of the animals and 4 to 21 of their annotated landmarks, right or with one
fault: ``wrong``: one landmark is at a random vertex, 0.3 √area or more from its place;
``exchanged``: two, 0.3 √area or more apart, are exchanged; ``sides``: left and right are exchanged
in the whole list; ``other numbers``: all are at random vertices. Half of the choices have the four
feet. The cat and the horse, and the busts, are checked with right landmarks only. Prints a Markdown
table: how many were told, and for how many the line says what is wrong. Seconds are those of the
processor.
"""

from __future__ import annotations

import argparse
import io
import itertools
import time
from pathlib import Path

import numpy as np
import torch
from correspondence import Annotated, annotated
from rich.console import Console

from nsm.domains.joint_preparation import Mesh
from nsm.pipeline.landmark_check import check_landmarks

ANIMALS = [f"shrec07-{k}" for k in (381, 383, 384, 385, 388, 391, 392, 393, 395, 397, 398, 400)]
OTHERS = (("cat_horse-0", "cat_horse-1"), ("shrec07-302", "shrec07-314"))
COUNTS = (4, 5, 6, 8, 12, 21)
FEET = (5, 7, 9, 11)
FAULTS = ("none", "wrong", "exchanged", "sides", "other numbers")
# each landmark's counterpart on the other side
OPPOSITE = [0, 1, 3, 2, 10, 11, 8, 9, 6, 7, 4, 5, 12, 13, 14, 16, 15, 18, 17, 20, 19]
FAR = 0.3


def faulty(
    fault: str, which: np.ndarray, target: Annotated, rng: np.random.Generator
) -> tuple[np.ndarray, str]:
    """The target's landmarks with a fault, and what the line should say."""
    ids = target.landmarks[which].copy()
    if fault == "wrong":
        k = int(rng.integers(len(ids)))
        ids[k] = rng.choice(np.flatnonzero(target.distance[which[k]] > FAR))
        return ids, f"landmark {k} ("
    if fault == "exchanged":
        apart = target.distance[np.ix_(which, ids)]
        pairs = [(i, j) for i, j in itertools.combinations(range(len(ids)), 2) if apart[i, j] > FAR]
        i, j = pairs[int(rng.integers(len(pairs)))]
        ids[[i, j]] = ids[[j, i]]
        return ids, "exchanged"
    if fault == "sides":
        return target.landmarks[np.array(OPPOSITE)[which]], "sides"
    if fault == "other numbers":
        return rng.choice(len(target.vertices), len(ids), replace=False), "do not fit"
    return ids, ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--meshes", type=Path, required=True)
    parser.add_argument("--trials", type=int, default=20, help="of each fault")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    rng = np.random.default_rng(given.seed)
    names = [*ANIMALS, *itertools.chain(*OTHERS)]
    shapes = {name: annotated(given.meshes, name) for name in names}
    told: dict[str, list[tuple[bool, bool, float]]] = {}

    def trial(row: str, ends: tuple[str, str], which: np.ndarray, fault: str) -> None:
        source, target = (shapes[name] for name in ends)
        ids, said = faulty(fault, which, target, rng)
        meshes = [Mesh(n, *shapes[n].mesh) for n in ends]
        console = Console(file=io.StringIO())
        began = time.process_time()
        check = check_landmarks(meshes, [source.landmarks[which], ids], console)
        seconds = time.process_time() - began
        line = "" if check is None or check.warning is None else check.warning.plain
        told.setdefault(row, []).append((bool(line), bool(line) and said in line, seconds))

    for _ in range(given.trials):
        for fault in FAULTS:
            first, second = rng.choice(ANIMALS, 2, replace=False)
            count = int(rng.choice(COUNTS))
            rest = np.setdiff1d(np.arange(len(OPPOSITE)), FEET)
            with_feet = [*FEET, *rng.choice(rest, count - len(FEET), replace=False)]
            anywhere = rng.choice(len(OPPOSITE), count, replace=False)
            which = np.array(with_feet) if rng.random() < 0.5 else np.sort(anywhere)
            trial(f"animals, {fault}", (str(first), str(second)), which, fault)
    for ends in itertools.chain(OTHERS, ((b, a) for a, b in OTHERS)):
        for count in COUNTS[:-1]:
            several = min(count, len(shapes[ends[0]].landmarks))
            which = rng.choice(len(shapes[ends[0]].landmarks), several, replace=False)
            trial("others, none", ends, which, "none")
    print("| landmarks with the fault | checked | told | and what | seconds, mean | largest |")
    print("|---|---|---|---|---|---|")
    for row, found in told.items():
        warned, right, seconds = zip(*found, strict=True)
        named = "–" if row.endswith("none") else sum(right)
        times = f"{np.mean(seconds):.1f} | {max(seconds):.1f}"
        print(f"| {row} | {len(found)} | {sum(warned)} | {named} | {times} |", flush=True)


if __name__ == "__main__":
    main()
