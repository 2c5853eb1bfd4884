"""The activation of the network: distance and wrinkles of the neural surface.

A network of the paper's kind (residual, fully connected, no feature grid) is overfitted to one
mesh with each activation and otherwise equal settings; :mod:`nsm.results.wrinkles` defines the
measure of wrinkles. Complete runs are not repeated.

    python benchmarks/activation.py --meshes FOLDER
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from PIL import Image
from rich.console import Console

from nsm.config import compose_config
from nsm.pipeline import run
from nsm.results import NeuralSurface, atomic_write, load_surface
from nsm.results.metrics import evaluate
from nsm.results.render import View
from nsm.results.report import write_report
from nsm.surfaces.geometry import subdivide

ROOT = Path(__file__).parent.parent
RESULT = ROOT / "benchmarks" / "results" / "activation.json"
PICTURES = ROOT / "docs" / "pictures"
SURFACE = "shrec07-384"
STEPS = 800
SETTINGS = [
    "map=residual",
    "encoding=fourier",
    "data.batch_size=1000",
    f"trainer.max_steps={STEPS}",
    "trainer.log_pictures=0",
]
# sin(ωz) needs the initialization that was published with it
OWN = {"sine": ["map.initialization=siren"]}
ACTIVATIONS = (
    "softplus",
    "softplus_paper",
    "relu",
    "leaky_relu",
    "elu",
    "silu",
    "gelu",
    "tanh",
    "sine",
)
COLUMNS = {
    "rms_percent": "RMS distance, % of diagonal",
    "normal_error_mean_degrees": "normal error, mean, degrees",
    "normal_variation_error_degrees": "normal variation, error, degrees over 1 %",
    "normal_variation_excess_degrees": "normal variation, excess, degrees over 1 %",
}
_SIDE = 360
_GREY = np.array([0.80, 0.82, 0.85])


def _picture(view: View, vertices: np.ndarray, faces: np.ndarray, name: str) -> None:
    image = view.draw(vertices, faces, lambda blend: _GREY)
    picture = Image.fromarray(np.round(255 * image).astype(np.uint8))
    picture.convert("L").save(PICTURES / f"activation-{name}.png", optimize=True)


def _pictures(name: str, neural: NeuralSurface) -> None:
    """Draw the trunk of the animal, where the source is smooth, on a much finer mesh."""
    surface = neural.surface
    across, up = (surface.vertices @ View(surface.vertices, _SIDE).frame.T).T[:2]
    trunk = np.ones(len(across), dtype=bool)
    for place in (across, up):
        low, high = np.percentile(place, [30, 95])
        trunk &= (place > low) & (place < high)
    view = View(surface.vertices[trunk], _SIDE)
    uv, faces = surface.uv, surface.faces
    for _ in range(2):
        uv, faces = subdivide(uv, faces)
    _picture(view, evaluate(neural.map, uv), faces, name)
    if name == ACTIVATIONS[0]:
        _picture(view, surface.vertices, surface.faces, "source")


def _table(runs: dict[str, dict[str, dict[str, float]]]) -> str:
    lines = ["| activation | " + " | ".join(COLUMNS.values()) + " |", "|---" * 5 + "|"]
    for name, found in runs.items():
        cells = [f"{found['metrics'][key]:.3f}" for key in COLUMNS]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--meshes", type=Path, help="folder with the mesh file; else fetched")
    parser.add_argument("--names", nargs="+", default=list(ACTIVATIONS), choices=ACTIVATIONS)
    parser.add_argument("--folder", type=Path, default=Path("outputs/activation"))
    arguments = parser.parse_args()
    mesh = f"surface={SURFACE}"
    if arguments.meshes:
        mesh = f"surface.path={arguments.meshes / SURFACE}.off"
    console = Console()
    results = {}
    for name in arguments.names:
        folder = arguments.folder / name
        if not (folder / "metrics.json").exists():
            settings = [mesh, f"activation={name}", *SETTINGS, *OWN.get(name, [])]
            run(compose_config(settings), folder)
        found = json.loads((folder / "metrics.json").read_text())
        kept = {key: found[key] for key in ("steps", "metrics")}
        results[name] = {"settings": [*SETTINGS, *OWN.get(name, [])], **kept}
        _pictures(name, load_surface(folder))
    text = json.dumps({"surface": SURFACE, "runs": results}, indent=1) + "\n"
    atomic_write(RESULT, text.encode())
    atomic_write(RESULT.with_suffix(".md"), _table(results).encode())
    write_report([arguments.folder], arguments.folder / "report.html", "Activations")
    console.print(_table(results))
    console.print(f"{RESULT}\n{arguments.folder / 'report.html'}", soft_wrap=True)


if __name__ == "__main__":
    main()
