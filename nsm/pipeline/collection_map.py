"""task=collection_map: several surfaces put into correspondence, every one with every other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_lightning as pl
import torch
from rich.text import Text

from nsm.data import CollectionData, SurfaceData
from nsm.domains.joint_preparation import Matched, matched_landmarks
from nsm.domains.orbifold.alignment import alignments_to_first
from nsm.errors import NsmError
from nsm.instantiation import named_object, target_of
from nsm.maps import LatticeAligned, Rotated
from nsm.pipeline.resolve_inputs import (
    landmark_vertices,
    neural_surfaces,
    read_shape,
    refuse_other_topology,
)
from nsm.pipeline.task import Given, Task, frozen
from nsm.results import (
    NeuralSurface,
    SurfaceCollection,
    collection_metrics,
    collection_table,
    export_surface,
    figures_picture,
    map_image,
    transfer_matrix_picture,
    warning_of_tears,
)
from nsm.results.metrics import evaluate
from nsm.tasks import CollectionMap
from nsm.tasks.initial_rotation import aligned, landmark_rotation, least_distorting_rotation

_SEAM_POINTS = 24  # on each branch
_RINGS = 80  # of an even mesh of the common domain


class CollectionMapTask(Task):
    """Several surfaces in correspondence, all pairs at once.

    The common domain is that of the first surface, but for the landmarks, which lie at the mean of
    where the surfaces have them.
    """

    module, data = CollectionMap, CollectionData
    result, defaults = SurfaceCollection, "collection_map"
    certified = True
    closed_domains = True
    table = staticmethod(collection_table)
    picture_name = "map"

    def inputs(self, given: Given) -> list[Any]:
        surfaces = self.settings["surfaces"] if given.surfaces is None else given.surfaces
        return list(surfaces) if isinstance(surfaces, (list, tuple)) else []

    def prepare(self, given: Given) -> None:
        self.keep_absolute("surfaces", "landmarks")
        surfaces = self.settings["surfaces"] if given.surfaces is None else given.surfaces
        if not isinstance(surfaces, Sequence) or isinstance(surfaces, str) or len(surfaces) < 3:
            raise NsmError(
                "setting surfaces: a collection needs a list of three surfaces or more",
                kind="out_of_range",
                key="surfaces",
            )
        shapes = [
            read_shape(surface, self.domain, f"surfaces[{k}]", self.config.trust)
            for k, surface in enumerate(surfaces)
        ]
        landmarks = self.settings["landmarks"] if given.landmarks is None else given.landmarks
        ids = landmark_vertices(landmarks, shapes, self.console)
        self.use(neural_surfaces(self.config, shapes, ids, self.console), ids)

    def use(self, phis: Sequence[NeuralSurface], ids: Sequence[np.ndarray]) -> None:
        """Take the surfaces, and the landmarks as vertices (L,) of their mesh files."""
        self.choose_domain(Given(surfaces=phis))
        refuse_other_topology(phis)
        self.phis, self.ids, self.surface = list(phis), ids, phis[0].surface
        self.matched = matched_landmarks([phi.surface for phi in phis], ids)
        targets = torch.as_tensor(np.stack(self.matched.points), dtype=torch.float32)
        self.targets, self.starts = targets, self._starts(targets)
        back = torch.stack([h.back(q) for h, q in zip(self.starts, targets, strict=True)])
        if not self.domain.has_boundary:
            back = torch.stack([self.domain.lift(x, targets[0]) for x in back])
        self.points = back.mean(dim=0)
        on_boundary = slice(self.matched.on_boundary)
        if self.domain.has_boundary:
            self.points[on_boundary] = self.domain.to_boundary(self.points[on_boundary])

    def _starts(self, targets: torch.Tensor) -> list[Rotated | LatticeAligned]:
        """Rotations, or affine maps of the lattice, from the common domain to the surfaces'."""
        surfaces = [phi.surface for phi in self.phis]
        if not self.domain.has_boundary:
            common = self.ids if targets.shape[1] else None
            return [aligned(found.inverse) for found in alignments_to_first(surfaces, common)]
        uv = torch.as_tensor(self.surface.uv, dtype=torch.float32)
        some = uv[:: len(uv) // 4096 + 1]
        first, *others = self.phis
        rotations = [torch.eye(2)]
        for k, phi in enumerate(others, start=1):
            if targets.shape[1]:
                rotations.append(landmark_rotation(self.domain, targets[0], targets[k]))
            else:
                rotation = least_distorting_rotation(self.domain, first.map, phi.map, some)
                rotations.append(rotation)
        return [Rotated(torch.nn.Identity(), rotation) for rotation in rotations]

    @property
    def title(self) -> str:
        return f"{self.name} of {len(self.phis)} surfaces"

    def build(self) -> Any:
        return self.module(
            **self.map_settings(),
            points=self.points,
            targets=self.targets,
            seam=torch.as_tensor(self._seam(), dtype=torch.float32),
            starts=self.starts,
            mesh=self._mesh(),
            diagonals=[phi.surface.bounding_box_diagonal for phi in self.phis],
            phis=[self.tabulated(phi) for phi in self.phis],
        )

    def _mesh(self) -> tuple[torch.Tensor, torch.Tensor]:
        """All surfaces and an even mesh of the common domain, as one mesh: uv and faces.

        No h_i may fold a triangle of any surface, as F_{i→j} maps those of i through h_j; nor fold
        anywhere between them, where samples are rare, or its inverse would be lost.
        """
        even, even_faces = self.domain.mesh(_RINGS)
        vertices = [
            start.back(torch.as_tensor(phi.surface.uv, dtype=torch.float32))
            for phi, start in zip(self.phis, self.starts, strict=True)
        ]
        vertices.append(torch.as_tensor(even, dtype=torch.float32))
        first = np.cumsum([0, *(len(v) for v in vertices[:-1])])
        parts = [*(phi.surface.faces for phi in self.phis), even_faces]
        faces = np.concatenate([part + n for part, n in zip(parts, first, strict=True)])
        return torch.cat(vertices), torch.as_tensor(faces)

    def _seam(self) -> np.ndarray:
        """(T, 2, 2) points of the common ∂Ω that are one point of each surface."""
        matched = self.matched
        if matched.on_boundary < 2 or not all(len(phi.surface.seam_pairs) for phi in self.phis):
            return np.zeros((0, 2, 2))
        points = self.points.double().numpy()
        common = Matched([points], matched.numbers, matched.on_boundary)
        return common.seam(self.domain, _SEAM_POINTS)

    def build_data(self) -> pl.LightningDataModule:
        surfaces = [phi.surface for phi in self.phis]
        return self.made_data(surfaces=surfaces, starts=self.starts)

    @property
    def data_settings(self) -> dict[str, Any]:
        """Those of the group ``data``; the options for one surface serve several as well."""
        settings = super().data_settings
        one_surface = named_object(settings["_target_"]) is SurfaceData
        return {**settings, "_target_": target_of(CollectionData)} if one_surface else settings

    def make_result(self, module: Any) -> SurfaceCollection:
        maps = [frozen(h) for h in module.map]
        return SurfaceCollection(self.phis, maps, np.stack(self.ids, axis=1), {}, self.settings)

    def measure(self, result: SurfaceCollection) -> None:
        points = self.points.double().numpy()
        result.metrics.update(collection_metrics(result, points, self.matched.points))

    def warnings(self, result: SurfaceCollection) -> list[Text]:
        every = (warning_of_tears(name, of) for name, of in result.metrics["pairs"].items())
        return [torn for torn in every if torn is not None]

    def figures(self, result: SurfaceCollection) -> dict[str, Any]:
        names = [phi.surface.name for phi in self.phis]
        return {"surfaces": names, "landmarks": len(self.ids[0])}

    def picture(self, module: Any) -> np.ndarray:
        # where the vertices of the first go if h_0 is taken for its start
        start = self.starts[0].back(torch.as_tensor(self.surface.uv, dtype=torch.float32))
        uv = evaluate(module.map[-1], start.numpy())
        return map_image(self.surface, self.phis[-1].surface, uv)

    def write_artefacts(self, folder: Path, result: SurfaceCollection) -> None:
        figures_picture(folder / "figures.png", result)
        transfer_matrix_picture(folder / "transfer.png", result)
        for i, source in enumerate(result.surfaces):
            for j, target in enumerate(result.surfaces):
                if i != j:
                    self._write_pair(folder / f"{i}_to_{j}", result.pair(i, j), source, target)

    def _write_pair(
        self, folder: Path, f: Any, source: NeuralSurface, target: NeuralSurface
    ) -> None:
        folder.mkdir(exist_ok=True)
        image = target.in_original_units(f.welded_image)
        np.save(folder / "mapped_vertices.npy", image)
        vertices = target.in_original_units(target.surface.vertices)
        file = folder / "target_with_source_uv.glb"
        export_surface(file, vertices, target.surface, f.source_uv)
