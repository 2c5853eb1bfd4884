"""The activation of the network: distance and wrinkles of the neural surface.

The sweep of activations: a network of the paper's kind (residual, fully connected, seeing (u, v)
alone) is overfitted to one mesh with each activation and otherwise equal settings;
:mod:`nsm.results.wrinkles` defines the measure of wrinkles. Complete runs are not repeated.

    python benchmarks/activation.py --meshes FOLDER
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image
from training import NO_MAP

from nsm.domains import Surface
from nsm.results import NeuralSurface, atomic_write, load_surface
from nsm.results.metrics import evaluate
from nsm.results.render import View
from nsm.results.report import write_report
from nsm.surfaces.geometry import subdivide

ROOT = Path(__file__).parent.parent
RESULT = ROOT / "benchmarks" / "results" / "activation.json"
PICTURES = ROOT / "docs" / "pictures"
SURFACE = "shrec07-384"
# smaller network and batch than the sweep has, so that all jobs end within a quarter of an hour
SETTINGS = [
    "sweep=activation",
    "domain=disc",
    "map.width=64",
    "data.batch_size=500",
    "trainer.max_steps=5000",
    "trainer.log_pictures=0",
    "up=-z",
]
COLUMNS = {
    "rms_percent": "RMS distance, % of diagonal",
    "normal_error_mean_degrees": "normal error, mean, degrees",
    "normal_variation_error_degrees": "normal variation, error, degrees over 1 %",
    "normal_variation_excess_degrees": "normal variation, excess, degrees over 1 %",
}
_SIDE = 360
_GREY = np.array([0.80, 0.82, 0.85])


def evaluated(neural: NeuralSurface) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of φ's image, on a much finer mesh than the source's."""
    uv, faces = neural.surface.uv, neural.surface.faces
    for _ in range(2):
        uv, faces = subdivide(uv, faces)
    return evaluate(neural.map, uv), faces


def _picture_of(surface: Surface, mesh: tuple[np.ndarray, np.ndarray], name: str) -> None:
    """Draw the trunk of the animal, where the source is smooth."""
    across, up = (surface.vertices @ View(surface.vertices, _SIDE).frame.T).T[:2]
    trunk = np.ones(len(across), dtype=bool)
    for place in (across, up):
        low, high = np.percentile(place, [30, 95])
        trunk &= (place > low) & (place < high)
    image = View(surface.vertices[trunk], _SIDE).draw(*mesh, lambda blend: _GREY)
    picture = Image.fromarray(np.round(255 * image).astype(np.uint8))
    picture.convert("L").save(PICTURES / f"activation-{name}.png", optimize=True)


def _table(runs: dict[str, dict[str, dict[str, float]]]) -> str:
    lines = ["| activation | " + " | ".join(COLUMNS.values()) + " |", "|---" * 5 + "|"]
    for name, found in runs.items():
        cells = [f"{found['metrics'][key]:.3f}" for key in COLUMNS]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--meshes", type=Path, help="folder with the mesh file; else fetched")
    parser.add_argument("--folder", type=Path, default=Path("outputs/activation"))
    arguments = parser.parse_args()
    mesh = f"surface={SURFACE}"
    if arguments.meshes:
        mesh = f"surface.path={arguments.meshes / SURFACE}.off"
    words = ["-m", *SETTINGS, mesh, f"hydra.sweep.dir={arguments.folder}"]
    subprocess.run([sys.executable, "-m", "nsm.cli", *words], check=True)
    results = {}
    for folder in sorted(file.parent for file in arguments.folder.glob("*/metrics.json")):
        found = json.loads((folder / "metrics.json").read_text())
        name = folder.name.removeprefix("activation_").rpartition("-")[0]
        results[name] = {key: found[key] for key in ("steps", "metrics")}
        neural = load_surface(folder)
        _picture_of(neural.surface, evaluated(neural), name)
    _picture_of(neural.surface, (neural.surface.vertices, neural.surface.faces), "source")
    with Image.open(arguments.folder / "sweep.png") as image:
        small = image.convert("RGB").resize((900, 900 * image.height // image.width))
        small.save(PICTURES / "activation-sweep.jpg", quality=85)
    found = {"surface": SURFACE, "settings": SETTINGS, "flips": NO_MAP, "runs": results}
    text = json.dumps(found, indent=1) + "\n"
    atomic_write(RESULT, text.encode())
    atomic_write(RESULT.with_suffix(".md"), _table(results).encode())
    write_report([arguments.folder], arguments.folder / "report.html", "Activations")
    print(_table(results), RESULT, arguments.folder / "report.html", sep="\n")


if __name__ == "__main__":
    main()
