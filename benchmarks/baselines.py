"""The paper's comparison: a pair of animals, mapped by every means, in a table and a picture.

    python benchmarks/baselines.py --meshes FOLDER [--command 'PROGRAM {source} ...' --name NAME]

The means are nsm's default; the paper's settings for h, on surfaces and seams of the default; the
default's parameterizations, composed without optimization; another program (see peers.py), by
default nearest_points.py; and the published recipe, as far as published.py has measured it.

Seconds are the CPU time of the map on one thread, those of another program from file to file.
Flips are those of the map of Ω, which another program has not.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from maps import PICTURES, UP, VARIANTS, at_start, mapped, study_of, table, values
from peers import figures, image_by_command, pair_of
from PIL import Image

from nsm.results import atomic_write
from nsm.results.pair_pictures import distorted
from nsm.results.pictures import checked, panels, save_figure
from nsm.results.render import View, upright
from nsm.surfaces.loading import load_mesh

RESULT = Path(__file__).parent / "results" / "baselines.json"
PAIR = "384-388"
NEAREST = [sys.executable, str(Path(__file__).parent / "nearest_points.py")]
WORDS = " {source} {target} {landmarks} {image}"
WAYS = {
    "nsm, default": VARIANTS["default"],
    "the paper's settings of h, 1,500 steps": VARIANTS["h of the paper, as many steps"],
}
COMPOSED = "the default's parameterizations, composed"
COLUMNS = {
    "symmetric_dirichlet_median": "median",
    "symmetric_dirichlet_mean": "mean",
    "symmetric_dirichlet_p95": "95th percentile",
    "flipped_before_repair_percent": "flipped % before repair",
    "flipped_percent": "after",
    "landmark_error_max_percent": "landmark error, largest",
}
_SIDE = 420


def picture(file: Path, f: Any, images: dict[str, tuple[np.ndarray, float]]) -> None:
    """The checkerboard of the source on its image by each means, above its distortion.

    Args:
        file: to write.
        f: one of the maps, for its surfaces.
        images: (V, 3), of the source's vertices, in the normalised units of the target, and the
            median of the distortion.
    """
    source, target = f.source.surface, f.target.surface
    view = View(source.vertices, _SIDE)
    shown = View(f.aligned(target.vertices), _SIDE, frame=view.frame)
    board, seam = checked(source.uv), source.seam_pairs
    above = [(view.draw(source.vertices, source.faces, board, seam), source.name)]
    grey = shown.draw(f.aligned(target.vertices), target.faces, lambda blend: np.full(3, 0.8))
    below = [(grey, target.name)]
    for name, (image, median) in images.items():
        on_target = shown.draw(f.aligned(image), source.faces, board, seam)
        above.append((on_target, name.replace(", ", ",\n")))
        title = f"symmetric Dirichlet, 3.98 to 20:\nmedian {median:.3f}"
        below.append((distorted(view, source, image), title))
    save_figure(panels(above, below), file)


def published(file: Path) -> dict[str, dict[str, Any]]:
    """Maps of the published recipe from the result of published.py; they are not repaired."""
    found = json.loads(file.read_text())
    labels = {
        "before": "parameterizations of the published recipe, composed",
        "published, on the way": f"{found['form']}, on the way",
        "published": f"{found['form']}, at its stop",
    }
    entries = {}
    for key, entry in found.items():
        what, _, stage = key.partition("/")
        if " → " in what and stage in labels:
            metrics = {**entry["metrics"]}
            metrics["flipped_before_repair_percent"] = metrics["flipped_percent"]
            entries[labels[stage]] = {"seconds": entry["seconds"], "metrics": metrics}
    return entries


def rows(found: dict[str, dict[str, Any]]) -> list[list[str]]:
    """The rows of the table."""
    result = []
    for name, entry in found.items():
        cells = values(entry["metrics"], COLUMNS)
        result.append([name, *cells, f"{entry['seconds']:.0f}"])
        if name == next(iter(WAYS)):
            result.append([COMPOSED, *at_start(entry["metrics"], COLUMNS), "0"])
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--meshes", type=Path, default=Path("../shared/meshes"))
    parser.add_argument("--command", default=shlex.join(NEAREST) + WORDS, help="see peers.py")
    parser.add_argument("--name", default="nearest points", help="of the program")
    given = parser.parse_args()
    torch.set_num_threads(1)
    found: dict[str, dict[str, Any]] = {}
    images: dict[str, tuple[np.ndarray, float]] = {}
    key = "symmetric_dirichlet_median"
    f: Any = None
    for name, settings in WAYS.items():
        g, seconds = mapped(*study_of(given.meshes), settings)
        found[name] = {"seconds": seconds, "metrics": g.metrics}
        images[name], f = (g.image, g.metrics[key]), f or g
    source, target = f.source.surface, f.target.surface
    start = target.at(source.uv @ f.map.rotation.numpy().T)
    images[COMPOSED] = start, f.metrics[f"start_{key}"]
    files, marks = pair_of(given.meshes, PAIR)
    meshes = [load_mesh(file)[:2] for file in files]
    image, seconds = image_by_command(given.command, *meshes, marks)
    told = figures(*meshes, image, marks, COLUMNS)
    found[given.name] = {"seconds": seconds, "metrics": told}
    normalised = (image[source.source_vertex] - target.center) * target.scale
    images[given.name] = normalised, told[key]
    for file in sorted(RESULT.parent.glob("published-*.json")):
        found |= published(file)
    atomic_write(RESULT, (json.dumps(found, indent=1) + "\n").encode())
    text = table(["map", *COLUMNS.values(), "seconds"], rows(found)) + "\n"
    atomic_write(RESULT.with_suffix(".md"), text.encode())
    drawn = RESULT.with_suffix(".png")
    with upright(UP):
        picture(drawn, f, images)
    with Image.open(drawn) as whole:
        small = whole.convert("RGB").resize((1600, 1600 * whole.height // whole.width))
        small.save(PICTURES / "paper-baselines.jpg", quality=85)
    drawn.unlink()
    print(text)


if __name__ == "__main__":
    main()
