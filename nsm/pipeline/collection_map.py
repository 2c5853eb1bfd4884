"""task=collection_map: several surfaces put into correspondence, every one with every other."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_lightning as pl
import torch
from rich.text import Text

from nsm.data import CollectionData, SurfaceData
from nsm.domains.joint_preparation import Mesh
from nsm.domains.matched_landmarks import Matched, matched_landmarks, with_ends
from nsm.domains.orbifold.collection_alignment import alignments_to_first, disagreements
from nsm.instantiation import named_object, target_of
from nsm.maps import LatticeAligned, Rotated
from nsm.pipeline.collection_inputs import collected
from nsm.pipeline.configured_surface import configured_repairs
from nsm.pipeline.landmark_check import LandmarkCheck, check_landmarks, draw_landmarks
from nsm.pipeline.landmark_inputs import name_of
from nsm.pipeline.proposed_landmarks import ProposedLandmarks, given_or_proposed
from nsm.pipeline.resolve_inputs import (
    neural_surfaces,
    read_shape,
    refuse_other_topology,
)
from nsm.pipeline.task import Given, Task, frozen
from nsm.results import (
    NeuralSurface,
    SurfaceCollection,
    SurfaceMap,
    collection_metrics,
    collection_table,
    export_surface,
    figures_picture,
    map_image,
    transfer_matrix_picture,
    warning_of_distortion,
    warning_of_faults,
    warning_of_misfit,
    warning_of_missed_landmarks,
    warning_of_tears,
    write_correspondences,
)
from nsm.results.collection_pictures import cycle_picture
from nsm.results.map_metrics import flipped_percent
from nsm.results.meshes import ColouredMesh, export_ply, painted
from nsm.results.metrics import evaluate
from nsm.results.pair_metrics import start_figures
from nsm.stages import counted, done_in_turn, stage
from nsm.surfaces.landmark_lookup import files_beside
from nsm.tasks import CollectionMap
from nsm.tasks.initial_rotation import (
    aligned,
    carried,
    landmark_rotation,
    least_distorting_rotation,
)

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
    has_template = False  # the first surface is one
    template_mesh: Mesh | None = None  # of its file
    proposed: ProposedLandmarks | None = None
    check: LandmarkCheck | None = None

    def inputs(self, given: Given) -> list[Any]:
        surfaces = self.settings["surfaces"] if given.surfaces is None else given.surfaces
        return collected(surfaces, self._template(given))

    def _template(self, given: Given) -> Any:
        # absent in older run folders
        return self.settings.get("template") if given.template is None else given.template

    def prepare(self, given: Given) -> None:
        surfaces, template = self.inputs(given), self._template(given)
        if given.surfaces is None:  # those that match a pattern now
            self.config.surfaces = surfaces if template is None else surfaces[1:]
        self.keep_absolute("surfaces", "template", "landmarks")
        with stage(self.console, f"{self.name}: reading"):
            shapes = [
                read_shape(surface, self.domain, f"surfaces[{k}]", self.config.trust)
                for k, surface in enumerate(surfaces)
            ]
        landmarks = self.settings["landmarks"] if given.landmarks is None else given.landmarks
        if landmarks is None:
            landmarks = files_beside(surfaces, [name_of(shape) for shape in shapes])
            if landmarks is not None:
                files = ", ".join(Path(file).name for file in landmarks)
                self.console.print(f"landmarks beside the meshes: {files}", soft_wrap=True)
        self.has_template = template is not None
        self.template_mesh = shapes[0] if isinstance(shapes[0], Mesh) else None
        shapes, ids, self.proposed = given_or_proposed(
            landmarks,
            shapes,
            self.domain,
            self.config,
            self.console,
            template=self.has_template,
        )
        repairs = configured_repairs(self.config)
        self.check = check_landmarks(shapes, ids, self.console, repairs, self.proposed)
        draw = partial(draw_landmarks, self.folder, landmarks=ids)
        self.use(neural_surfaces(self.config, shapes, ids, self.console, draw), ids)

    def use(self, phis: Sequence[NeuralSurface], ids: Sequence[np.ndarray]) -> None:
        """Take the surfaces, and the landmarks as vertices (L,) of their mesh files."""
        self.choose_domain(Given(surfaces=phis))
        refuse_other_topology(phis)
        ids = with_ends([phi.surface for phi in phis], ids)
        self.phis, self.ids, self.surface = list(phis), ids, phis[0].surface
        self.matched = matched_landmarks([phi.surface for phi in phis], ids)
        targets = torch.as_tensor(np.stack(self.matched.points), dtype=torch.float32)
        self.starts = self._starts(targets)
        there = torch.isfinite(targets).all(dim=-1)[..., None]
        some = torch.where(there, targets, 0.0)
        back = torch.stack([h.back(q) for h, q in zip(self.starts, some, strict=True)])
        if not self.domain.has_boundary:
            owner = there[..., 0].int().argmax(dim=0)
            first = back[owner, torch.arange(len(owner))]
            back = torch.stack([self.domain.lift(x, first, self.surface.lattice) for x in back])
        self.points = (back * there).sum(dim=0) / there.sum(dim=0)
        near = zip(self.phis, self.starts, some, strict=True)
        lifted = torch.stack(
            [self.domain.lift(q, h.before(self.points), phi.surface.lattice) for phi, h, q in near]
        )
        self.targets = torch.where(there, lifted, torch.nan)
        on_boundary = slice(self.matched.on_boundary)
        if self.domain.has_boundary:
            self.points[on_boundary] = self.domain.to_boundary(self.points[on_boundary])

    def _starts(self, targets: torch.Tensor) -> list[Rotated | LatticeAligned]:
        """Rotations, or affine maps of the lattice, from the common domain to the surfaces'."""
        surfaces = [phi.surface for phi in self.phis]
        if not self.domain.has_boundary:
            common = self.ids if targets.shape[1] else None
            with stage(self.console, f"{self.title}: isotopy classes"):
                to_first = alignments_to_first(surfaces, common)
                unlike = disagreements(surfaces, to_first, common)
            for pair in unlike:
                ends = f"{surfaces[pair.source].name} → {surfaces[pair.target].name}"
                self.console.print(
                    f"{ends}: the isotopy class that follows from the other pairs scores "
                    f"{pair.composed.score:.3f}, the pair's own best {pair.own.score:.3f}; if the "
                    "map is distorted, map the pair alone or check its landmarks",
                    soft_wrap=True,
                )
            return [aligned(found.inverse) for found in to_first]
        uv = torch.as_tensor(self.surface.uv, dtype=torch.float32)
        some = uv[:: len(uv) // 4096 + 1]
        first, *others = self.phis
        rotations = [torch.eye(2)]
        for k, phi in enumerate(others, start=1):
            both = torch.isfinite(targets[[0, k]]).all(dim=-1).all(dim=0)
            if both.any():
                rotations.append(landmark_rotation(self.domain, targets[0, both], targets[k, both]))
            else:
                rotation = least_distorting_rotation(self.domain, first.map, phi.map, some)
                rotations.append(rotation)
        return [Rotated(torch.nn.Identity(), rotation) for rotation in rotations]

    @property
    def title(self) -> str:
        return f"{self.name} of {len(self.phis)} surfaces"

    def build(self) -> Any:
        points, targets = self.points, self.targets
        if self.domain.has_boundary and self.config.constraints.boundary == "penalty":
            # as for pairs: the corners are key points (METHOD)
            corners = torch.from_numpy(self.domain.corners).to(points)
            points = torch.cat([points, corners])
            kept = torch.stack([start.before(corners) for start in self.starts])
            targets = torch.cat([targets, kept], dim=1)
        names = [phi.surface.name for phi in self.phis]
        return self.module(
            **self.map_settings(),
            points=points,
            targets=targets,
            seam=torch.as_tensor(self._seam(), dtype=torch.float32),
            starts=self.starts,
            mesh=self._mesh(),
            meshes=[
                (torch.as_tensor(s.uv, dtype=torch.float32), torch.as_tensor(s.faces))
                for s in (phi.surface for phi in self.phis)
            ],
            diagonals=[phi.surface.bounding_box_diagonal for phi in self.phis],
            phis=[self.tabulated(phi) for phi in self.phis],
            names=names if len(set(names)) == len(names) else None,
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
        for known in (self.proposed, self.check):
            result.metrics.update({} if known is None else known.figures)
        for (i, j), name in result.pair_names.items():
            figures = result.metrics["pairs"][name]
            source, target = self.phis[i].surface, self.phis[j].surface
            if self.trained is not None:
                before = flipped_percent(self.trained.pair(i, j).image_uv, source.faces)
                figures["flipped_before_repair_percent"] = before
            ends = self.starts[j], self.starts[i]
            both = self.matched.shared(i, j)
            begin, end = (self.matched.points[k][both] for k in (i, j))
            first, places = (carried(x, *ends) for x in (source.uv, begin))
            figures |= start_figures(source, target, first, places, end)

    def warnings(self, result: SurfaceCollection) -> list[Text]:
        pairs = result.metrics["pairs"]
        found = (
            None if self.proposed is None else self.proposed.warning,
            None if self.check is None else self.check.warning,
            warning_of_misfit({phi.surface.name: phi.metrics for phi in self.phis}),
            warning_of_distortion(pairs),
            warning_of_missed_landmarks(pairs),
            *(warning_of_tears(name, of) for name, of in pairs.items()),
            *(warning_of_faults(n, result.pair(*e)) for e, n in result.pair_names.items()),
        )
        return [warning for warning in found if warning is not None]

    def figures(self, result: SurfaceCollection) -> dict[str, Any]:
        said = {"surfaces": result.names, "landmarks": len(self.ids[0])}
        return {**said, "template": result.names[0]} if self.has_template else said

    def picture(self, module: Any) -> np.ndarray:
        own, image = self._first_and_last(module)
        return map_image(self.surface, self.phis[-1].surface, image, own)

    def mesh(self, module: Any) -> ColouredMesh:
        own, image = self._first_and_last(module)
        last = self.phis[-1].surface
        return painted(last.at(image), self.surface.faces, self.surface.at(own))

    def _first_and_last(self, module: Any) -> tuple[np.ndarray, np.ndarray]:
        """Points of the common domain in the domains of the first surface and of the last, (V, 2)
        each: no map is inverted. As h_0 starts they are the vertices of the first."""
        uv = torch.as_tensor(self.surface.uv, dtype=torch.float32)
        common = self.starts[0].back(uv).numpy()
        return evaluate(module.map[0], common), evaluate(module.map[-1], common)

    def save(self, folder: Path, result: SurfaceCollection) -> None:
        super().save(folder, result)
        if self.proposed is not None:
            (folder / "landmarks.json").write_text(self.proposed.to_json(), encoding="utf-8")

    def write_artefacts(self, folder: Path, result: SurfaceCollection) -> None:
        draws = {
            "figures.png": figures_picture,
            "transfer.png": transfer_matrix_picture,
            "cycle.png": cycle_picture,
        }
        done_in_turn("pictures", {n: partial(d, folder / n, result) for n, d in draws.items()})
        names = [re.sub(r"[/\\]", "_", name) for name in result.names]
        pairs = list(itertools.permutations(range(len(result)), 2))
        kept = [ends for ends in pairs if 0 in ends or not self.has_template]
        for i, j in counted("pairs written", kept):
            f = result.pair(i, j)
            self._write_pair(folder / f"{names[i]}_to_{names[j]}", f)
            if self.has_template and i == 0:
                export_ply(folder / f"{names[j]}_in_{names[0]}.ply", *self._on_template(f))

    def _on_template(self, f: SurfaceMap) -> tuple[np.ndarray, np.ndarray]:
        """The template's vertices (V, 3) on a scan, and the faces (F, 3) of its file, both in its
        order; faces of removed parts are left out."""
        points = f.target.in_original_units(f.welded_image)
        if self.template_mesh is None:
            return points, f.weld.faces
        # landmarks inside triangles are further vertices of the map, not of the file
        count, faces = len(self.template_mesh.vertices), self.template_mesh.faces
        there = f.source.surface.cut_vertex >= 0
        return points[:count], np.asarray(faces[there[faces].all(axis=1)])

    def _write_pair(self, folder: Path, f: SurfaceMap) -> None:
        target = f.target
        folder.mkdir(exist_ok=True)
        image = target.in_original_units(f.welded_image)
        np.save(folder / "mapped_vertices.npy", image)
        write_correspondences(folder / "correspondences.npz", f)
        vertices = target.in_original_units(target.surface.vertices)
        file = folder / "target_with_source_uv.glb"
        export_surface(file, vertices, target.surface, f.source_uv)
