"""Flattenings of the charts of a mesh, packed into one atlas."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from nsm.errors import NsmError
from nsm.results.file_faces import faces_of_file
from nsm.results.files import atomic_write
from nsm.results.meshes import export_mesh
from nsm.results.parameterization import Parameterization, in_file_units, load_parameterization
from nsm.results.patterns import write_patterns
from nsm.results.textures import checkerboard
from nsm.surfaces.atlas import packed

FILE = "atlas.json"


@dataclass(frozen=True, eq=False)
class ParameterizationAtlas:
    """Flattened charts of one mesh.

    Attributes:
        charts: one for each chart; ``charts[k].uv`` is in the chart's normalised units.
    """

    charts: list[Parameterization]

    @property
    def metrics(self) -> dict[str, dict[str, float]]:
        """The figures of each chart, by its name; before them those of the texture coordinates that
        it started from, if it did, as ``NAME, given UV``."""
        found = {}
        for chart in self.charts:
            name = chart.phi.surface.name
            if "given" in chart.metrics:
                found[f"{name}, given UV"] = chart.metrics["given"]
            found[name] = chart.metrics["nsm"]
        return found

    @property
    def config(self) -> dict[str, Any]:
        """The settings of the run that made it."""
        return self.charts[0].config

    @cached_property
    def _packed(self) -> tuple[list[np.ndarray], float]:
        flat = [(in_file_units(c), c.phi.surface.faces) for c in self.charts]
        return packed(flat)

    @property
    def uv(self) -> list[np.ndarray]:
        """For each chart the places (V, 2) of its vertices in the unit square, all in one scale."""
        return self._packed[0]

    @property
    def scale(self) -> float:
        """Length in the unit square over length in the units of the mesh file."""
        return self._packed[1]

    def save(self, folder: str | Path) -> None:
        """Write the charts into ``part_0``, ... of a folder.

        Raises:
            OSError: the folder cannot be written.
        """
        place = Path(folder)
        for k, chart in enumerate(self.charts):
            chart.save(place / f"part_{k}")
        text = json.dumps({"format": "nsm-atlas", "charts": len(self.charts)})
        atomic_write(place / FILE, text.encode())

    def export(self, folder: str | Path) -> None:
        """Write ``parameterized.obj`` and ``.glb``, the mesh with the atlas as texture coordinates,
        and ``pattern.svg`` and ``.dxf``, the outlines in the units of the mesh file.

        The OBJ file has the vertices of the mesh file, in its order.

        Raises:
            OSError: the folder cannot be written.
        """
        place, surfaces = Path(folder), [chart.phi.surface for chart in self.charts]
        first = np.cumsum([0, *(len(uv) for uv in self.uv)])
        uv = np.concatenate(self.uv)
        shown = [s.faces[~s.filled] + n for s, n in zip(surfaces, first, strict=False)]
        faces = np.concatenate(shown)
        points = np.concatenate(
            [c.phi.in_original_units(c.phi.surface.vertices) for c in self.charts]
        )
        write_patterns(place / "pattern", uv / self.scale, faces)
        square = 2 * uv - 1
        export_mesh(place / "parameterized.glb", points, faces, square, texture=checkerboard())
        both = [faces_of_file(s) for s in surfaces]
        export_mesh(
            place / "parameterized.obj",
            self.charts[0].phi.file_mesh()[0],
            np.concatenate([own for own, _ in both]),
            square,
            corners=np.concatenate([c + n for (_, c), n in zip(both, first, strict=False)]),
        )


def load_atlas(folder: str | Path, trust: Iterable[str] = ()) -> ParameterizationAtlas:
    """Read what :meth:`ParameterizationAtlas.save` wrote.

    Args, Raises:
        as for :func:`nsm.results.load_surface`.
    """
    file = Path(folder) / FILE
    try:
        count = int(json.loads(file.read_text(encoding="utf-8"))["charts"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise NsmError(
            f"{file}: damaged; make the run again", kind="damaged_file", key=str(file)
        ) from error
    charts = [load_parameterization(Path(folder) / f"part_{k}", trust) for k in range(count)]
    return ParameterizationAtlas(charts)
