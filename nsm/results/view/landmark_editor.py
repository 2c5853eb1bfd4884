"""Landmarks placed by clicks: the shapes side by side in the browser, and the panel beside them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from nsm.correspondence.landmark_list import LandmarkList
from nsm.correspondence.preview import previewed
from nsm.errors import NsmError
from nsm.results.files import atomic_write
from nsm.results.meshes import by_position
from nsm.results.view.colours import distinct_colours
from nsm.results.view.picking import hit
from nsm.results.view.scene import FIELD_OF_VIEW, beside_the_panel
from nsm.wording import number_of

_GAP = 1.3  # between the middles of shapes, in diameters
_RADIUS = 0.02  # of a marker; every shape has the diameter one
_GREY, _UNPLACED = (190, 190, 190), "–"


@dataclass(frozen=True, eq=False)
class EditedShape:
    """A mesh to place landmarks on.

    Attributes:
        name: its label.
        vertices: (V, 3), in file units.
        faces: (F, 3).
        numbers: (V,) the vertices' numbers in the file.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    numbers: np.ndarray

    def placed(self, k: int) -> np.ndarray:
        """The vertices (V, 3) in the scene, as the k-th shape from the left."""
        low, high = self.vertices.min(axis=0), self.vertices.max(axis=0)
        size = np.linalg.norm(high - low)
        return (self.vertices - 0.5 * (low + high)) / size + [k * _GAP, 0.0, 0.0]


class LandmarkEditor:
    """Landmarks of several shapes in the browser.

    A click on a shape adds a point there; a click on a marker selects its landmark, whose markers
    can then be dragged. The panel names, deletes, undoes, checks and saves.

    Args:
        shapes: two or more.
        landmarks: to begin with, as vertices of ``EditedShape.vertices``.
        file: where they are saved.
        server: a ``viser.ViserServer``.
    """

    def __init__(
        self, shapes: Sequence[EditedShape], landmarks: LandmarkList, file: Path, server: Any
    ) -> None:
        self.shapes, self.landmarks, self.file, self.server = shapes, landmarks, file, server
        self.placed = [shape.placed(k) for k, shape in enumerate(shapes)]
        self.selected: int | None = None
        self.markers: dict[tuple[int, int], Any] = {}
        self.handles: list[Any] = []  # by which the selected landmark is dragged
        self._lock = threading.RLock()  # viser runs callbacks in several threads
        server.scene.set_up_direction("+y")
        corners = np.concatenate(self.placed)
        low, high = corners.min(axis=0), corners.max(axis=0)
        aside, distance = beside_the_panel(*(0.5 * (high - low)))
        aim = 0.5 * (low + high) + [aside, 0.0, 0.0]
        server.initial_camera.fov = FIELD_OF_VIEW
        server.initial_camera.position = tuple(aim + [0.0, 0.0, distance])
        server.initial_camera.look_at = tuple(aim)
        self._build_panel()
        self.paint(None)
        server.scene.on_click()(self.on_click)
        self.show()

    def on_click(self, event: Any) -> None:
        """Select the marker under the mouse, or place a point on the shape there."""
        with self._lock:
            origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
            found = self._under(origin, direction)
            if found is None:
                return
            side, vertex, point = found
            near = self._marker_near(side, point)
            self.selected = self.landmarks.place(side, vertex) if near is None else near
            self.show()

    def drag(self, number: int, side: int, position: Sequence[float]) -> None:
        """Move a landmark's point on a shape to the vertex nearest to a place of the scene."""
        with self._lock:
            apart = np.linalg.norm(self.placed[side] - np.asarray(position), axis=1)
            if not self.landmarks.move(number, side, int(apart.argmin())):
                self.message.content = "another landmark is there already"
            self.show()

    def delete(self) -> None:
        """Remove the selected landmark."""
        if self.selected is not None:
            self.landmarks.delete(self.selected)
            self.selected = None
            self.show()

    def undo(self) -> None:
        """Take the last change back."""
        self.landmarks.undo()
        self.selected = None
        self.show()

    def rename(self) -> None:
        """Give the selected landmark the name in the panel."""
        if self.selected is None or self.name.value == self._names[self.selected]:
            return
        if not self.landmarks.rename(self.selected, self.name.value):
            self.message.content = "each landmark needs a name of its own"
        self.show()

    def save(self) -> None:
        """Write the landmarks that are placed on all shapes, in the numbers of the mesh files."""
        names, lists = self.landmarks.complete()
        ids = [s.numbers[np.array(x, dtype=int)] for s, x in zip(self.shapes, lists, strict=True)]
        text = LandmarkList(len(self.shapes), ids, names).to_json()
        left = len(self.landmarks.landmarks) - len(names)
        try:
            atomic_write(self.file, text.encode())
        except OSError as error:
            self.message.content = f"not saved: {error.strerror}"
            return
        missing = f", {left} left out that are not on all shapes" if left else ""
        self.message.content = f"{number_of(len(names), 'landmark')} saved in {self.file}{missing}"

    def check(self) -> None:
        """Colour the first shape by position, the others as their coarse maps carry it there."""
        names, lists = self.landmarks.complete()
        source = self.shapes[0]
        colours = [255 * by_position(self.placed[0])]
        lines = []
        try:
            for shape, ids in zip(self.shapes[1:], lists[1:], strict=True):
                found = previewed(
                    (source.vertices, source.faces),
                    (shape.vertices, shape.faces),
                    (np.array(lists[0]), np.array(ids)),
                )
                colours.append(_carried(colours[0], found.candidate, shape.vertices))
                worst = int(found.off.argmax())
                lines.append(
                    f"{source.name} → {shape.name}: mean energy {found.energy:.2f} (3.98 at best); "
                    f"{names[worst]} is farthest off, {found.off[worst]:.2f} of √area"
                )
        except NsmError as error:
            self.message.content = str(error)
            return
        self.paint(colours)
        self.message.content = "\n\n".join(lines)

    def paint(self, colours: Sequence[np.ndarray] | None) -> None:
        """Draw the shapes, with colours (V, 3) in [0, 255] of their vertices, or grey."""
        for k, shape in enumerate(self.shapes):
            every = np.tile(_GREY, (len(shape.vertices), 1)) if colours is None else colours[k]
            mesh = trimesh.Trimesh(
                self.placed[k],
                shape.faces,
                vertex_colors=every.astype(np.uint8),
                process=False,
            )
            self.server.scene.add_mesh_trimesh(f"/shape{k}/mesh", mesh)
            top = self.placed[k].mean(axis=0) + [0, 0.6, 0]
            self.server.scene.add_label(f"/shape{k}/name", shape.name, position=top)

    def show(self) -> None:
        """Draw the markers anew, and the list in the panel."""
        for mark in (*self.markers.values(), *self.handles):
            mark.remove()
        self.markers, self.handles = {}, []
        for number, landmark in enumerate(self.landmarks.landmarks):
            for side, vertex in enumerate(landmark.vertices):
                if vertex is not None:
                    self._show_point(number, side, vertex)
        self._names = [mark.name for mark in self.landmarks.landmarks]
        rows = [
            " | ".join(
                [f"**{m.name}**" if k == self.selected else m.name]
                + [
                    _UNPLACED if v is None else str(shape.numbers[v])
                    for v, shape in zip(m.vertices, self.shapes, strict=True)
                ]
            )
            for k, m in enumerate(self.landmarks.landmarks)
        ]
        head = " | ".join(["name", *(shape.name for shape in self.shapes)])
        rule = "|".join(["---"] * (1 + len(self.shapes)))
        self.list.content = "\n".join([head, rule, *rows])
        self.name.value = "" if self.selected is None else self._names[self.selected]

    def _show_point(self, number: int, side: int, vertex: int) -> None:
        colour = distinct_colours(len(self.landmarks.landmarks))[number]
        position = self.placed[side][vertex]
        name = f"/shape{side}/landmark{number}"
        self.markers[number, side] = self.server.scene.add_icosphere(
            name,
            radius=_RADIUS * (1.6 if number == self.selected else 1.0),
            color=tuple(colour.tolist()),
            position=position,
        )
        self.server.scene.add_label(
            f"{name}/name", self.landmarks.landmarks[number].name, position=(0, 1.5 * _RADIUS, 0)
        )
        if number == self.selected:
            handle = self.server.scene.add_transform_controls(
                f"{name}_handle", scale=0.12, disable_rotations=True, position=position
            )
            handle.on_drag_end(lambda _: self.drag(number, side, handle.position))
            self.handles.append(handle)

    def _under(
        self, origin: np.ndarray, direction: np.ndarray
    ) -> tuple[int, int, np.ndarray] | None:
        """The first shape that a ray hits, its vertex there, and the point (3,)."""
        hits = []
        for side, (shape, vertices) in enumerate(zip(self.shapes, self.placed, strict=True)):
            found = hit(origin, direction, vertices, shape.faces)
            if found is not None:
                hits.append((found[0], side, found[1]))
        if not hits:
            return None
        _, side, place = min(hits, key=lambda item: item[0])
        vertex = self.shapes[side].faces[place.face[0], place.weights[0].argmax()]
        return side, int(vertex), place.take(self.placed[side], self.shapes[side].faces)[0]

    def _marker_near(self, side: int, point: np.ndarray) -> int | None:
        """The landmark whose marker covers a point of a shape."""
        for number, landmark in enumerate(self.landmarks.landmarks):
            vertex = landmark.vertices[side]
            if vertex is not None:
                apart = np.linalg.norm(self.placed[side][vertex] - point)
                if apart < 1.2 * _RADIUS:
                    return number
        return None

    def _build_panel(self) -> None:
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.add_markdown(
            "Click each shape in turn to add a landmark. Click a marker to select it; drag its "
            "arrows to move it."
        )
        self.name = gui.add_text("name", "")
        self.name.on_update(self._locked(self.rename))
        for label in ("delete", "undo", "check", "save"):
            gui.add_button(label).on_click(self._locked(getattr(self, label)))
        self.message = gui.add_markdown("")
        self.list = gui.add_markdown("")

    def _locked(self, act: Callable[[], None]) -> Callable[[Any], None]:
        def call(_: Any) -> None:
            with self._lock:
                act()

        return call


def _carried(colours: np.ndarray, candidate: Any, vertices: np.ndarray) -> np.ndarray:
    """The source's colours (V, 3) on the target's vertices (W, 3): of the nearest image."""
    from scipy.spatial import cKDTree

    source, target = candidate.source.shape, candidate.target.shape
    images = vertices[target.ids[candidate.images(np.arange(len(source.ids)))]]
    nearest = cKDTree(images).query(vertices)[1]
    return np.asarray(colours[source.ids[nearest]])
