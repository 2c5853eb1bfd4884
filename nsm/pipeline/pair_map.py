"""task=pair_map: a map from one surface to another."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_lightning as pl
import torch
from rich.console import Console
from rich.text import Text

from nsm.data import SurfaceData
from nsm.domains.matched_landmarks import matched_landmarks, with_ends
from nsm.domains.orbifold.alignment import Alignment, alignments
from nsm.errors import NsmError
from nsm.maps import AnalyticSurface, LatticeAligned, Remembered, Rotated
from nsm.pipeline.attributes import read_attributes, write_transferred
from nsm.pipeline.configured_surface import configured_repairs
from nsm.pipeline.landmark_check import LandmarkCheck, check_landmarks, draw_landmarks
from nsm.pipeline.parts import closed_parts
from nsm.pipeline.proposed_landmarks import ProposedLandmarks, given_or_proposed
from nsm.pipeline.resolve_inputs import (
    Shape,
    neural_surfaces,
    read_shape,
    refuse_other_topology,
    vertex_count,
)
from nsm.pipeline.task import Given, Task, frozen
from nsm.pipeline.textures import Textures, read_textures, write_textured
from nsm.results import (
    NeuralSurface,
    SurfaceMap,
    distortion_picture,
    export_mesh,
    export_surface,
    map_image,
    mean_log_distortion,
    morph_pictures,
    pair_metrics,
    pair_table,
    reliability_picture,
    transfer_picture,
    warning_of_distortion,
    warning_of_faults,
    warning_of_folds,
    warning_of_misfit,
    warning_of_missed_landmarks,
    warning_of_no_landmarks,
    warning_of_tears,
    write_correspondences,
    write_reliability,
)
from nsm.results.file_faces import faces_of_file
from nsm.results.map_metrics import flipped_percent
from nsm.results.meshes import ColouredMesh, painted
from nsm.results.metrics import evaluate
from nsm.results.pair_metrics import start_figures
from nsm.results.pair_pictures import normals_picture
from nsm.stages import done_in_turn, stage
from nsm.surfaces.topology import face_areas
from nsm.tasks import PairMap
from nsm.tasks.initial_rotation import (
    aligned,
    carried,
    landmark_rotation,
    least_distorting_rotation,
)

_MORPH_FRAMES = 9
_CLASSES_SHOWN, _CLASSES_TRIED = 4, 3
# percent of the diagonal: landmarks that stay so far off are on the wrong side of a twist
_MISSED = 1.0
# weight of the largest miss, in units in which the surfaces have the area of Ω, beside the mean
# logarithm of the distortion, where classes are compared after their training
_MISS = 3.0


class PairMapTask(Task):
    """A map from one surface to another, with least distortion."""

    module, data, result, defaults = PairMap, SurfaceData, SurfaceMap, "pair_map"
    closed_domains = True
    parts_into_wholes = True
    certified = True
    table = staticmethod(pair_table)
    picture_name = "map"
    attributes: dict[str, np.ndarray]
    textures: Textures | None = None
    proposed: ProposedLandmarks | None = None
    check: LandmarkCheck | None = None

    def inputs(self, given: Given) -> list[Any]:
        ends = (("source", given.source), ("target", given.target))
        return [self.settings[key] if end is None else end for key, end in ends]

    def prepare(self, given: Given) -> None:
        self.keep_absolute("source", "target", "landmarks", "attributes", "texture")
        settings = self.settings
        ends = self.inputs(given)
        with stage(self.console, f"{self.name}: reading"):
            shapes = [
                read_shape(end, self.domain, key, self.config.trust)
                for key, end in zip(("source", "target"), ends, strict=True)
            ]
            self.textures = read_textures(settings["texture"], ends, shapes)
        landmarks = settings["landmarks"] if given.landmarks is None else given.landmarks
        of_files = self.textures is not None or any(settings["attributes"].values())
        counts = [vertex_count(shape) for shape in shapes]
        shapes, ids, self.proposed = given_or_proposed(
            landmarks, shapes, self.domain, self.config, self.console, exact=not of_files
        )
        repairs = configured_repairs(self.config)
        self.check = check_landmarks(shapes, ids, self.console, repairs, self.proposed)
        self.attributes = read_attributes(settings["attributes"], counts)
        shapes = closed_parts(shapes, ids, self.domain, repairs, self.console)
        try:
            phi, psi = self._neural(shapes, ids)
        except NsmError as error:
            if self.proposed is None or error.kind != "no_common_seam":
                raise
            self.console.print(f"no landmarks are proposed: {error}", soft_wrap=True)
            ids = [one[: self.proposed.given] for one in ids]
            self.proposed, self.check = None, None
            phi, psi = self._neural(shapes, ids)
        self.use(phi, psi, ids)

    def _neural(
        self, shapes: Sequence[Shape], ids: Sequence[np.ndarray]
    ) -> tuple[NeuralSurface, NeuralSurface]:
        """Source and target, laid out and overfitted, with landmarks (L,) of each."""
        draw = partial(draw_landmarks, self.folder, landmarks=ids)
        cones = None if self.check is None or self.domain.has_boundary else self.check.cones
        phi, psi = neural_surfaces(self.config, shapes, ids, self.console, draw, cones)
        return phi, psi

    def use(self, phi: NeuralSurface, psi: NeuralSurface, ids: Sequence[np.ndarray]) -> None:
        """Take source and target, and the landmarks as vertices (L,) of their mesh files."""
        self.choose_domain(Given(source=phi, target=psi))
        refuse_other_topology([phi, psi])
        ids = with_ends([phi.surface, psi.surface], ids)
        self.phi, self.psi, self.ids, self.surface = phi, psi, ids, phi.surface
        self.tried: dict[int, float] = {}
        self.matched = matched_landmarks([phi.surface, psi.surface], ids)
        if not self.domain.has_boundary:
            common = (ids[0], ids[1]) if len(ids[0]) else None
            with stage(self.console, f"{self.title}: isotopy classes"):
                self.alignments = alignments(phi.surface.part, psi.surface, common)
            scores = ", ".join(f"{one.score:.3f}" for one in self.alignments[:_CLASSES_SHOWN])
            self.console.print(f"likely isotopy classes, best first: scores {scores}")

    @property
    def title(self) -> str:
        return f"{self.name} {self.surface.name} → {self.psi.surface.name}"

    def build(self) -> Any:
        source, target = self.surface, self.psi.surface
        # where the seams correspond, both sides of the source's should go to one curve
        same_seam = len(target.seam_pairs) and self.matched.on_boundary >= 2
        seam_pairs = source.seam_pairs if same_seam else source.seam_pairs[:0]
        p, q, uv, seam = (
            torch.as_tensor(array, dtype=torch.float32)
            for array in (*self.matched.points, source.uv, source.uv[seam_pairs])
        )
        self.start = start = self._start(p, q)
        q = self.domain.lift(q, start.before(p), target.lattice)
        phi, psi = self._for_training()
        if self.domain.has_boundary and self.config.constraints.boundary == "penalty":
            # the exact boundary keeps corners by construction; here they are key points (METHOD)
            corners = torch.from_numpy(self.domain.corners).to(p)
            p, q = torch.cat([p, corners]), torch.cat([q, start.before(corners)])
        return self.module(
            **self.map_settings(),
            points=p,
            targets=q,
            seam=seam,
            start=start,
            mesh=(uv, torch.as_tensor(source.faces)),
            caps=None if source.caps is None else torch.as_tensor(source.caps),
            diagonal=target.bounding_box_diagonal,
            phi=phi,
            psi=psi,
        )

    def build_data(self) -> pl.LightningDataModule:
        """Samples of the source, none on caps."""
        return self.made_data(surface=self.surface.part)

    def _for_training(self) -> tuple[torch.nn.Module, torch.nn.Module]:
        """φ and ψ as the training evaluates them."""
        if self.config.trainer.tabulated is None:
            return self.phi.map, self.psi.map
        return Remembered(self.tabulated(self.phi)), self.tabulated(self.psi)

    def _start(self, p: torch.Tensor, q: torch.Tensor) -> Rotated | LatticeAligned:
        """The rotation, or affine map of the lattice, that h starts from, by landmarks p, q (L, 2)
        or by distortion."""
        if not self.domain.has_boundary:
            return aligned(self._alignment)
        if len(p):
            rotation = landmark_rotation(self.domain, p, q)
        else:
            some = torch.as_tensor(self.surface.uv[:: len(self.surface.uv) // 4096 + 1]).float()
            rotation = least_distorting_rotation(self.domain, self.phi.map, self.psi.map, some)
        return Rotated(torch.nn.Identity(), rotation)

    @property
    def _alignment(self) -> Alignment:
        """The start in the isotopy class of the settings.

        Raises:
            NsmError: ``out_of_range``: there are fewer likely classes.
        """
        number = self.config.get("isotopy_class", 0)  # absent in older run folders
        if number >= len(self.alignments):
            raise NsmError(
                f"isotopy_class={number}: there are {len(self.alignments)} likely classes; give a "
                f"number from 0 to {len(self.alignments) - 1}",
                kind="out_of_range",
                key="isotopy_class",
            )
        return self.alignments[number]

    def begin_again(self, module: Any) -> bool:
        """Whether the isotopy class is wrong: landmarks are still missed, or the map is worse than
        a start in the next class before any training. The next class is then tried; and in the
        end the best of those that were tried is taken, which is trained again."""
        if self.domain.has_boundary:
            return False
        number = self.config.isotopy_class
        more = number + 1 < min(_CLASSES_TRIED, len(self.alignments))
        if not more and not self.tried:
            return False
        result = self.make_result(module)
        after = mean_log_distortion(self.surface.part, result.part.image)
        missed = float(module.landmark_error().detach().max()) if len(module.points) else 0.0
        settled = number in self.tried
        self.tried[number] = after + _MISS * missed / 100 * self.psi.surface.bounding_box_diagonal
        said = (
            f"isotopy class {number}: mean log distortion {after:.3f}, landmarks missed by "
            f"{missed:.3g} % of the diagonal at worst"
        )
        following = number
        if more and not settled:
            after_it = self.alignments[number + 1].distortion
            said += f"; class {number + 1} before its training: {after_it:.3f}"
            if missed > _MISSED or after_it < after:
                following = number + 1
                said += f"; class {following} is tried"
        best = min(self.tried, key=lambda k: self.tried[k])
        if following == number and best != number and not settled:
            following = best
            said += f"; class {best} was better"
        self.console.print(said, soft_wrap=True)
        self.config.isotopy_class = following
        return bool(following != number)

    def make_result(self, module: Any) -> SurfaceMap:
        ids = np.stack(self.ids, axis=1)
        return SurfaceMap(self.phi, self.psi, frozen(module.map), ids, {}, self.settings)

    def measure(self, result: SurfaceMap) -> None:
        points, targets = self.matched.points
        landed = result.planar(points) if len(points) else points
        source, target = self.surface, self.psi.surface
        result.metrics.update(pair_metrics(source, target, result.image_uv, landed, targets))
        result.metrics.update(result.certificate)
        for known in (self.proposed, self.check):
            result.metrics.update({} if known is None else known.figures)
        if self._chosen_by_distortion:
            result.metrics["landmarks_sure"] = False
        if self.trained is not None:
            before = flipped_percent(self.trained.image_uv[source.of_part], source.part.faces)
            result.metrics["flipped_before_repair_percent"] = before
        first, places = (carried(x, self.start) for x in (source.uv, points))
        result.metrics.update(start_figures(source, target, first, places, targets))
        if len(source.seam_pairs) and source.domain.has_boundary:
            result.metrics.update(result.weld.figures(target.bounding_box_diagonal))

    @property
    def _chosen_by_distortion(self) -> bool:
        """Whether nothing but the distortion says which part of a mesh goes to which."""
        return not len(self.ids[0]) and not isinstance(self.psi.map, AnalyticSurface)

    def warnings(self, result: SurfaceMap) -> list[Text]:
        name = f"{self.surface.name} → {self.psi.surface.name}"
        found = (
            None if self.proposed is None else self.proposed.warning,
            None if self.check is None else self.check.warning,
            warning_of_no_landmarks(name) if self._chosen_by_distortion else None,
            warning_of_misfit({one.surface.name: one.metrics for one in (self.phi, self.psi)}),
            warning_of_distortion({name: result.metrics}),
            warning_of_folds({name: result.metrics}),
            warning_of_missed_landmarks({name: result.metrics}),
            warning_of_tears(name, result.metrics),
            warning_of_faults(name, result),
        )
        return [warning for warning in found if warning is not None]

    def figures(self, result: SurfaceMap) -> dict[str, Any]:
        said: dict[str, Any] = {
            "target": self.psi.surface.name,
            "landmarks": len(self.ids[0]),
            "statement": result.statement,  # of the certificate
        }
        caps = self.surface.caps
        if caps is not None:
            areas = face_areas(self.surface.vertices, self.surface.faces)
            said["caps_percent"] = 100 * float(areas[caps].sum() / areas.sum())
        if self.domain.has_boundary:
            return said
        classes = [
            {
                "matrix": a.matrix.astype(int).tolist(),
                "shift": a.shift.tolist(),
                "mean_log_distortion": a.distortion,
                "landmarks_missed": a.miss,
                "score": a.score,
            }
            for a in self.alignments[:_CLASSES_SHOWN]
        ]
        return {**said, "isotopy_class": self.config.isotopy_class, "isotopy_classes": classes}

    def picture(self, module: Any) -> np.ndarray:
        part = self.surface.part
        return map_image(part, self.psi.surface, evaluate(module, part.uv))

    def mesh(self, module: Any) -> ColouredMesh:
        part = self.surface.part
        image = self.psi.surface.at(evaluate(module, part.uv))
        return painted(image, part.faces, part.vertices)

    def save(self, folder: Path, result: SurfaceMap) -> None:
        super().save(folder, result)
        if self.proposed is not None:
            (folder / "landmarks.json").write_text(self.proposed.to_json(), encoding="utf-8")
        write_transferred(self.attributes, self.settings["attributes"], folder, result)
        if self.textures is not None:
            for line in write_textured(self.textures, folder, result, self.config.texture_size):
                self.console.print(line, soft_wrap=True)

    def write_artefacts(self, folder: Path, result: SurfaceMap) -> None:
        f = result

        def reliability() -> None:
            write_reliability(folder / "reliability.ply", f)
            reliability_picture(folder / "reliability.png", f)

        def morph() -> None:
            _write_morph(folder, f, self.console)
            morph_pictures(folder / "morph.png", folder / "morph.gif", f)

        works: dict[str, Callable[[], object]] = {
            "mapped": lambda: _write_image(folder, f),
            "textured meshes": lambda: _write_with_uv(folder, f),
            "correspondences.npz": lambda: write_correspondences(folder / "correspondences.npz", f),
            "reliability": reliability,
            "transfer.png": lambda: transfer_picture(folder / "transfer.png", f),
            "distortion.png": lambda: distortion_picture(folder / "distortion.png", f),
        }
        if isinstance(f.target.map, AnalyticSurface):
            works["normals.png"] = lambda: normals_picture(folder / "normals.png", f)
        done_in_turn("files", {**works, "morph": morph})


def _write_with_uv(folder: Path, f: SurfaceMap) -> None:
    """Each surface with the other one's coordinates in Ω."""
    s, t = f.source.surface, f.target.surface
    carried = np.where(f.unreached[:, None], np.nan, f.source_uv)
    meshes = {
        "target_with_source_uv": (f.target.in_original_units(t.vertices), t, carried),
        "source_with_target_uv": (f.source.in_original_units(s.vertices), s, f.image_uv),
    }
    for name, mesh in meshes.items():
        for ending in (".obj", ".glb"):
            export_surface(folder / f"{name}{ending}", *mesh)


def _write_morph(folder: Path, f: SurfaceMap, console: Console) -> None:
    """The path from the source to its image, with the vertices and faces of the source's file."""
    s = f.source.surface
    faces, corners = faces_of_file(s)
    uv = s.uv if s.domain.has_boundary else None
    (folder / "morph").mkdir(exist_ok=True)
    for k in range(_MORPH_FRAMES):
        frame = f.morph(k / (_MORPH_FRAMES - 1))
        export_mesh(folder / "morph" / f"{k:02d}.obj", frame, faces, uv, corners=corners)
    try:
        f.export_morph(folder / "morph.glb")
    except NsmError as error:  # of sizes that GLB has no numbers for
        console.print(f"  left out: {error}")


def _write_image(folder: Path, f: SurfaceMap) -> None:
    """The source's mesh on the target, welded: a closed one is closed."""
    s, weld = f.source.surface, f.weld
    image = f.target.in_original_units(f.welded_image)
    np.save(folder / "mapped_vertices.npy", image)
    points = f.target.in_original_units(weld.points)
    for ending in (".obj", ".glb"):
        export_surface(folder / f"mapped{ending}", points, s, s.uv)
