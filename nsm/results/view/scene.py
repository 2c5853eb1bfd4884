"""What the viewer shows of a run: two shapes side by side and the map between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize

from nsm.domains import Surface
from nsm.results.artifact import NeuralSurface
from nsm.results.meshes import by_position
from nsm.results.metrics import evaluate, vertex_error
from nsm.results.pair_metrics import triangle_energies
from nsm.results.parameterization import Parameterization
from nsm.results.parameterization_atlas import ParameterizationAtlas
from nsm.results.pictures import vertex_means
from nsm.results.render import frames_of, vertex_normals
from nsm.results.surface_map import SurfaceMap
from nsm.results.textures import GREY
from nsm.surfaces.cutting import seam_pairs
from nsm.surfaces.location import Places, locate
from nsm.surfaces.topology import edges_of, face_areas

POSITION, PLAIN = "position on the source", "plain"
_GAP = 0.2  # between the shapes, in widths of the wider one
_FIXED = {"symmetric dirichlet": (4.0, 20.0)}  # one scale for all maps; others use percentiles
_LARGEST = 1e3
_NO_VERTICES = np.zeros(0, dtype=np.int64)
_ONE_SQUARE = np.array([1 / 32, 1 / 32])  # the middle of a square of the checkerboard
FIELD_OF_VIEW = float(np.radians(18))  # narrow: both shapes are seen from the same direction
_ASPECT, _ASIDE = 1.5, 0.26  # of a browser window, with the panel at its right


def beside_the_panel(width: float, height: float, depth: float) -> tuple[float, float]:
    """How far to the right of the middle a camera of :data:`FIELD_OF_VIEW` looks, and from how far
    away, to see a box of half this width, height and depth beside the panel."""
    tangent = float(np.tan(0.5 * FIELD_OF_VIEW))
    return _ASIDE * width, 1.1 * max(width / (_ASPECT * tangent), height / tangent) + depth


@dataclass(frozen=True, eq=False)
class Shape:
    """A mesh to display and to pick points on.

    Attributes:
        name: its label.
        vertices: (V, 3) displayed positions, around the origin.
        faces: (F, 3).
        uv: (V, 2) coordinates in its domain.
        coordinates: (V, 3) or (V, 2) the numbers displayed for a vertex: in the units of the mesh
            file, or the new coordinates of a flattening.
        seam_pairs: (T, 2) copies of the same vertex of the uncut mesh.
        landmarks: (L,) vertices.
        closed: the mesh was not cut; copies of a vertex are lifts of it.
        numbers: (V,) the vertices' numbers in the mesh file, -1 for points that were inserted.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    coordinates: np.ndarray
    seam_pairs: np.ndarray
    landmarks: np.ndarray = field(default_factory=lambda: _NO_VERTICES)
    closed: bool = False
    numbers: np.ndarray = field(default_factory=lambda: _NO_VERTICES)

    @cached_property
    def _uncut(self) -> np.ndarray:
        """For each vertex (V,) the first copy of the same vertex of the uncut mesh."""
        first = np.arange(len(self.vertices))
        first[self.seam_pairs[:, 1]] = self.seam_pairs[:, 0]
        return first

    @cached_property
    def seam(self) -> np.ndarray:
        """The edges (E, 2) along which the mesh was cut, each once."""
        if self.closed:
            return np.zeros((0, 2), dtype=np.int64)
        edges = edges_of(self.faces)
        boundary = edges.pairs[edges.count == 1]
        uncut = np.sort(self._uncut[boundary], axis=1)
        _, first, count = np.unique(uncut, axis=0, return_index=True, return_counts=True)
        return boundary[first[count > 1]]

    def normals(self, vertices: np.ndarray) -> np.ndarray:
        """Unit normals (V, 3) with its vertices at (V, 3), smooth across the seam."""
        return vertex_normals(vertices, self.faces, self.seam_pairs)


class Scale(NamedTuple):
    """A colour scale: its ends, and whether it is logarithmic."""

    low: float
    high: float
    log: bool

    def colours(self, values: np.ndarray) -> np.ndarray:
        """Colours (N, 3) in [0, 1] of values (N,)."""
        norm = (LogNorm if self.log else Normalize)(self.low, self.high)
        return ScalarMappable(norm, "viridis").to_rgba(values)[:, :3]

    def bar(self, count: int) -> np.ndarray:
        """The colours (count, 3) of the scale, from low to high."""
        ends = np.geomspace if self.log else np.linspace
        return self.colours(ends(self.low, self.high, count))


class Paint(NamedTuple):
    """Colours of the vertices (V, 3) in [0, 1], or their coordinates (V, 2) on a checkerboard, or
    those (F, 3, 2) of the corners of the faces."""

    colours: np.ndarray | None
    checkerboard: np.ndarray | None


@dataclass(frozen=True, eq=False)
class Scene:
    """A source and a target, and the map between them.

    Attributes:
        source, target: the two shapes.
        image_uv: (V, 2) images of the source's vertices in the target's domain. The map is linear
            on each triangle of the source.
        image: (V, 3) their images on the displayed target.
        frame: (3, 3) unit vectors to the right, up and towards the viewer, as rows.
        checkerboards: for each name, coordinates (V, 2) of the source's vertices in [-1, 1]².
        energies: for each name, values (F,) on the source's triangles.
        errors: for each name, values (V,) at its vertices.
        locate: where points (N, 2) of the target's domain lie on a mesh over it: uv (V, 2), faces.
        lift: on a closed domain, the representatives of points (N, 2) nearest to others (N, 2).
        unreached: mask (W,) of the target's vertices to which no point of the source goes; None:
            there are none.
    """

    source: Shape
    target: Shape
    image_uv: np.ndarray
    image: np.ndarray
    frame: np.ndarray
    checkerboards: dict[str, np.ndarray]
    energies: dict[str, np.ndarray]
    errors: dict[str, np.ndarray] = field(default_factory=dict)
    locate: Callable[[np.ndarray, np.ndarray, np.ndarray], Places] = locate
    lift: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    unreached: np.ndarray | None = None

    @property
    def shapes(self) -> tuple[Shape, Shape]:
        return self.source, self.target

    @property
    def colourings(self) -> list[str]:
        """The names that :meth:`paint` accepts."""
        return [*self.checkerboards, *self.errors, *self.energies, POSITION, PLAIN]

    @cached_property
    def _preimages(self) -> Places:
        return self.locate(self.target.uv, self.image_uv, self.source.faces)

    def transferred(self, values: np.ndarray) -> np.ndarray:
        """Values (V, ...) at the source's vertices, transferred to the target's (W, ...)."""
        return self._preimages.take(values, self.source.faces)

    def corresponding(self, side: int, places: Places) -> Places:
        """The points of the other shape that correspond to places on one (0: the source)."""
        if side == 0:
            uv = places.take(self.image_uv, self.source.faces)
            return self.locate(uv, self.target.uv, self.target.faces)
        uv = places.take(self.target.uv, self.target.faces)
        return self.locate(uv, self.image_uv, self.source.faces)

    def morph(self, t: float) -> np.ndarray:
        """The source's vertices (V, 3) moved straight towards their images, t from 0 to 1."""
        return (1 - t) * self.source.vertices + t * self.image

    def paint(self, name: str) -> tuple[Paint, Paint]:
        """The paint of both shapes; a point and its image have the same colour."""
        if name in self.checkerboards:
            checkerboard = self.checkerboards[name]
            return Paint(None, checkerboard), Paint(None, self._carried(checkerboard))
        vertices = self.source.vertices
        scale = self.scale(name)
        if scale is not None:
            values = self._at_vertices(name)
            on_target = self.transferred(values)
            carried = self._shown(scale.colours(on_target), GREY)
            return Paint(scale.colours(values), None), Paint(carried, None)
        colours = np.tile(GREY, (len(vertices), 1))
        if name == POSITION:
            colours = by_position(vertices)
        return Paint(colours, None), Paint(self._shown(self.transferred(colours), GREY), None)

    def _carried(self, checkerboard: np.ndarray) -> np.ndarray:
        """A checkerboard of the source, (V, 2), on the target: (W, 2), or (G, 3, 2) at the corners
        of its faces, where the source's lifts differ from vertex to vertex."""
        carried = self.transferred(checkerboard)
        if self.lift is None:
            return self._shown(carried, _ONE_SQUARE)
        faces = self.target.faces
        corners = carried[faces]
        for k in (1, 2):
            corners[:, k] = self.lift(corners[:, k], corners[:, 0])
        if self.unreached is not None:
            corners[self.unreached[faces].any(axis=1)] = _ONE_SQUARE
        return corners

    def _shown(self, carried: np.ndarray, nothing: np.ndarray) -> np.ndarray:
        """Values (W, d) at the target's vertices, with ``nothing`` (d,) where no point goes."""
        if self.unreached is None:
            return carried
        return np.where(self.unreached[:, None], nothing, carried)

    def scale(self, name: str) -> Scale | None:
        """The colour scale of an energy or error; None for other colourings."""
        if name not in self.energies and name not in self.errors:
            return None
        if name in _FIXED:
            return Scale(*_FIXED[name], log=True)
        values = self.errors.get(name, self.energies.get(name, np.zeros(0)))
        finite = values[np.isfinite(values)]
        low, high = np.percentile(finite, [1, 98]) if len(finite) else (0.0, 0.0)
        return Scale(float(low), float(max(high, low + 1e-9)), log=False)

    def _at_vertices(self, name: str) -> np.ndarray:
        if name in self.errors:
            return self.errors[name]
        # a degenerate triangle would dominate the mean at its vertices
        bounded = np.minimum(np.nan_to_num(self.energies[name], nan=np.inf), _LARGEST)
        return vertex_means(bounded, self.source.faces, len(self.source.vertices))

    @cached_property
    def offsets(self) -> np.ndarray:
        """(2, 3) positions of the shapes' origins, side by side."""
        half = self._half[:, 0]
        gap = _GAP * half.max()
        right = self.frame[0]
        return np.stack([-(half[1] + gap) * right, (half[0] + gap) * right])

    @cached_property
    def _half(self) -> np.ndarray:
        """(2, 3) half of each shape's width, height and depth in the view."""
        return np.stack([np.abs(s.vertices @ self.frame.T).max(axis=0) for s in self.shapes])

    @property
    def camera(self) -> tuple[np.ndarray, np.ndarray]:
        """Position and target (3,) of a camera that sees both shapes (:attr:`field_of_view`)."""
        width = self._half[:, 0].sum() + _GAP * self._half[:, 0].max()
        height, depth = self._half[:, 1:].max(axis=0)
        aside, distance = beside_the_panel(width, height, depth)
        aim = aside * self.frame[0]
        return aim + distance * self.frame[2], aim

    field_of_view = FIELD_OF_VIEW


Shown = NeuralSurface | Parameterization | ParameterizationAtlas | SurfaceMap


def scene_of(result: Shown, up: str = "y") -> Scene:
    """A mesh beside its neural surface or its flattening, or the two surfaces of a map.

    Args:
        result: of a run.
        up: the axis of the (source's) mesh file that points up, of
            :data:`nsm.results.render.UP_AXES`.
    """
    if isinstance(result, ParameterizationAtlas):
        return _atlas(result, up)
    mesh = result.source if isinstance(result, SurfaceMap) else result
    mesh = mesh.phi if isinstance(mesh, Parameterization) else mesh
    frame = frames_of(mesh.surface.part.vertices)[up]
    if isinstance(result, SurfaceMap):
        return _pair(result, frame)
    if isinstance(result, Parameterization):
        return _flattening(result, frame)
    return _overfit(result, frame)


def _overfit(neural: NeuralSurface, frame: np.ndarray) -> Scene:
    s = neural.surface
    image = evaluate(neural.map, s.uv)
    errors = {"distance, % of diagonal": vertex_error(s, neural.map)}
    centre = _centre(s.vertices, frame)
    source = _file_shape(f"{s.name}: mesh", neural, s.vertices - centre, s.vertices)
    target = _file_shape(f"{s.name}: neural surface", neural, image - centre, image)
    checkerboards = {"checkerboard of the domain": s.uv}
    energies = _energies(s, image)
    locate = s.domain.locate
    shown = (source, target, s.uv, target.vertices, frame)
    return Scene(*shown, checkerboards, energies, errors, locate, _lift(s))


def _flattening(result: Parameterization, frame: np.ndarray) -> Scene:
    s, uv = result.phi.surface, result.uv
    middle = 0.5 * (uv.min(axis=0) + uv.max(axis=0))
    # facing the viewer, whatever the frame
    flat = (uv - middle) @ frame[:2]
    source = _file_shape(s.name, result.phi, s.vertices - _centre(s.vertices, frame), s.vertices)
    name, numbers = f"{s.name}: flattened", s.source_vertex
    target = Shape(name, flat, s.faces, s.uv, uv, s.seam_pairs, numbers=numbers)
    checkerboards = {
        "checkerboard of the plane": 2 * (uv - middle) / np.ptp(uv, axis=0).max(),
        "checkerboard of the domain": s.uv,
    }
    return Scene(source, target, s.uv, flat, frame, checkerboards, _energies(s, uv))


def _atlas(result: ParameterizationAtlas, up: str) -> Scene:
    """All charts as one mesh, beside their places in the atlas, both in one unit; the domain of
    both is the atlas, where no two charts overlap."""
    surfaces = [chart.phi.surface for chart in result.charts]
    first = np.cumsum([0, *(len(s.uv) for s in surfaces)])
    faces = np.concatenate([s.faces + n for s, n in zip(surfaces, first, strict=False)])
    points = np.concatenate(
        [c.phi.in_original_units(c.phi.surface.vertices) for c in result.charts]
    )
    uv = np.concatenate(result.uv)
    # as everywhere: the surface has the area of the disc
    unit = np.sqrt(np.pi / face_areas(points, faces).sum())
    vertices, flat = unit * points, unit / result.scale * uv
    frame = frames_of(vertices)[up]
    numbers = np.concatenate([s.source_vertex for s in surfaces])
    pairs = seam_pairs(numbers)
    middle = 0.5 * (flat.min(axis=0) + flat.max(axis=0))
    laid = (flat - middle) @ frame[:2]
    name = surfaces[0].name.rpartition("-")[0]
    start = vertices - _centre(vertices, frame)
    source = Shape(name, start, faces, uv, points, pairs, numbers=numbers)
    target = Shape(f"{name}: atlas", laid, faces, uv, uv, pairs, numbers=numbers)
    checkerboards = {
        "checkerboard of the plane": 2 * (flat - middle) / np.ptp(flat, axis=0).max(),
        "checkerboard of the domain": np.concatenate([s.uv for s in surfaces]),
    }
    energies = _named(triangle_energies(vertices, flat, faces))
    return Scene(source, target, uv, laid, frame, checkerboards, energies)


def _pair(f: SurfaceMap, frame: np.ndarray) -> Scene:
    unreached = f.unreached if f.unreached.any() else None
    f = f.part
    s, t = f.source.surface, f.target.surface
    turned = f.aligned(t.vertices)
    centre = _centre(turned, frame)
    start = s.vertices - _centre(s.vertices, frame)
    source = _file_shape(s.name, f.source, start, s.vertices, f.landmarks[:, 0])
    target = _file_shape(t.name, f.target, turned - centre, t.vertices, f.landmarks[:, 1])
    checkerboards = {"checkerboard of the source": s.uv, "checkerboard of the target": f.image_uv}
    image = f.aligned_image - centre
    energies, locate = _energies(s, f.image), s.domain.locate
    shown = (source, target, f.image_uv, image, frame)
    lift = _lift(s)
    return Scene(*shown, checkerboards, energies, {}, locate, lift, unreached)


def _lift(surface: Surface) -> Callable[[np.ndarray, np.ndarray], np.ndarray] | None:
    """Of a surface on a closed domain, as :attr:`Scene.lift`."""
    if surface.domain.has_boundary:
        return None

    def lift(points: np.ndarray, near: np.ndarray) -> np.ndarray:
        pair = torch.from_numpy(points), torch.from_numpy(near)
        lifted: np.ndarray = surface.domain.lift(*pair, surface.lattice).numpy()
        return lifted

    return lift


def _file_shape(
    name: str,
    neural: NeuralSurface,
    shown: np.ndarray,
    vertices: np.ndarray,
    landmarks: np.ndarray = _NO_VERTICES,
) -> Shape:
    """A surface of a mesh file, with landmarks (L,) as vertices of the uncut mesh."""
    s = neural.surface
    coordinates = neural.in_original_units(vertices)
    closed, marked = not s.domain.has_boundary, s.cut_vertex[landmarks]
    return Shape(
        name, shown, s.faces, s.uv, coordinates, s.seam_pairs, marked, closed, s.source_vertex
    )


def _energies(surface: Surface, image: np.ndarray) -> dict[str, np.ndarray]:
    return _named(triangle_energies(surface.vertices, image, surface.faces))


def _named(energies: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name.replace("_", " "): value for name, value in energies.items()}


def _centre(vertices: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """The centre (3,) of a shape's bounding box in the view."""
    seen = vertices @ frame.T
    return 0.5 * (seen.min(axis=0) + seen.max(axis=0)) @ frame
