"""The viewer in the browser. What it shows is worked out in the modules beside this one."""

from __future__ import annotations

import contextlib
import errno
import io
import socket
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from matplotlib.colors import hsv_to_rgb
from trimesh.creation import icosphere

from nsm.errors import NsmError
from nsm.optional_dependencies import needed
from nsm.results.artifact import NeuralSurface
from nsm.results.collection import SurfaceCollection
from nsm.results.parameterization import Parameterization
from nsm.results.surface_map import SurfaceMap
from nsm.results.view.glb import as_glb
from nsm.results.view.picking import Pick, pick
from nsm.results.view.scene import UPS, scene_of

Result = NeuralSurface | Parameterization | SurfaceMap | SurfaceCollection

_NODES = "/source", "/target"
# of the last picks, on both shapes; when all are taken, the oldest pick goes
PICK_COLOURS = {
    "red": (214, 39, 40),
    "blue": (31, 119, 220),
    "green": (44, 160, 44),
    "purple": (148, 90, 200),
    "orange": (255, 140, 0),
}
_SOURCE_SEAM, _TARGET_SEAM = (255, 120, 0), (0, 150, 200)
# in normalised units, in which every surface has the area of Ω
_PICK_RADIUS, _LANDMARK_RADIUS, _SEAM_WIDTH, _LIFT = 0.03, 0.014, 0.01, 0.004
_BAR = (12, 256)


class Viewer:
    """What a run made, in a browser, and what a click there does.

    Args:
        result: what :func:`nsm.load` gave.
        server: viser's server.
    """

    def __init__(self, result: Result, server: Any) -> None:
        self.result, self.server = result, server
        self.picks: dict[str, Pick] = {}  # by the name of their colour, the oldest first
        self.markers: dict[str, tuple[Any, Any]] = {}
        self._marks: list[Any] = []
        self._lock = threading.RLock()  # viser calls back in threads, many at a time
        self._ends = [0, 1]
        self.scene = scene_of(self._map())
        self._build_panel()
        self._show_scene()
        server.scene.on_click()(self.on_click)

    def _map(self) -> NeuralSurface | Parameterization | SurfaceMap:
        if isinstance(self.result, SurfaceCollection):
            return self.result.pair(*self._ends)
        return self.result

    @property
    def shown(self) -> tuple[np.ndarray, np.ndarray]:
        """The vertices (V, 3) of both shapes as they are now, without the scene's offsets."""
        return self.scene.morph(self.way.value), self.scene.target.vertices

    def on_click(self, event: Any) -> None:
        """Mark the point under the mouse and the one that corresponds to it."""
        with self._lock:
            ray = np.array(event.ray_origin), np.array(event.ray_direction)
            found = pick(self.scene, *ray, self.shown)
            if found is None:
                return
            if len(self.picks) == len(PICK_COLOURS):
                self.picks.pop(next(iter(self.picks)))
            free = next(colour for colour in PICK_COLOURS if colour not in self.picks)
            self.picks[free] = found
            self._show_picks()

    def _build_panel(self) -> None:
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        self.ends: list[Any] = []
        if isinstance(self.result, SurfaceCollection):
            names = [f"{k}: {phi.surface.name}" for k, phi in enumerate(self.result.surfaces)]
            for side, word in enumerate(("source", "target")):
                choice = gui.add_dropdown(word, names, initial_value=names[self._ends[side]])
                choice.on_update(self._locked(partial(self._choose, side)))
                self.ends.append(choice)
        names = self.scene.colourings
        self.colouring = gui.add_dropdown("colours", names, initial_value=names[0])
        self._bar = gui.add_image(np.zeros((*_BAR, 3), dtype=np.uint8), visible=False)
        self._bar_ends = gui.add_markdown("", visible=False)
        self.up = gui.add_dropdown("up", list(UPS), initial_value="y")
        self.way = gui.add_slider(
            "morph", 0.0, 1.0, 0.02, 0.0, hint="the left shape on its way to its image"
        )
        self.landmarks = gui.add_checkbox("landmarks", bool(len(self.scene.source.landmarks)))
        self.seams = gui.add_checkbox("seams", False)
        gui.add_markdown("A click on a shape marks the point, and its image on the other.")
        forget = gui.add_button("forget the points")
        self._list = gui.add_markdown("")
        self.colouring.on_update(self._locked(self._show_shapes))
        self.up.on_update(self._locked(self._renew))
        self.way.on_update(self._locked(self._show_way))
        self.landmarks.on_update(self._locked(self._show_marks))
        self.seams.on_update(self._locked(self._show_marks))
        forget.on_click(self._locked(self._forget))

    def _locked(self, act: Callable[[], None]) -> Callable[[Any], None]:
        def call(_: Any) -> None:
            with self._lock:
                act()

        return call

    def _choose(self, side: int) -> None:
        """Another pair of the collection; where both ends would be one, they change places."""
        chosen = [choice.options.index(choice.value) for choice in self.ends]
        if chosen == self._ends:
            return
        if chosen[0] == chosen[1]:
            chosen[1 - side] = self._ends[side]
        self._ends = chosen
        for choice, k in zip(self.ends, chosen, strict=True):
            choice.value = choice.options[k]
        self.picks.clear()
        self._renew()

    def _forget(self) -> None:
        self.picks.clear()
        self._show_picks()

    def _renew(self) -> None:
        self.scene = scene_of(self._map(), self.up.value)
        self._show_scene()

    def _show_scene(self) -> None:
        up = self.scene.frame[1]
        self.server.scene.set_up_direction(tuple(up))
        start = self.server.initial_camera
        start.fov, start.up = self.scene.field_of_view, tuple(up)
        start.position, start.look_at = self.scene.camera
        for client in self.server.get_clients().values():
            client.camera.up_direction = up
            client.camera.position, client.camera.look_at = self.scene.camera
        for node, shape, offset in zip(_NODES, self.scene.shapes, self.scene.offsets, strict=True):
            place = offset + 1.15 * (shape.vertices @ up).max() * up
            self.server.scene.add_label(
                f"{node}/name", shape.name, position=place, anchor="bottom-center"
            )
        self._show_shapes()
        self._show_marks()
        self._show_picks()

    def _show_shapes(self) -> None:
        self._drawn = self.way.value
        name = self.colouring.value
        for node, shape, vertices, paint, offset in zip(
            _NODES,
            self.scene.shapes,
            self.shown,
            self.scene.paint(name),
            self.scene.offsets,
            strict=True,
        ):
            data = as_glb(shape, vertices, paint)
            self.server.scene.add_glb(f"{node}/mesh", data, position=offset)
        scale = self.scene.scale(name)
        self._bar.visible = self._bar_ends.visible = scale is not None
        if scale is not None:
            colours = np.round(255 * scale.bar(_BAR[1])).astype(np.uint8)
            self._bar.image = np.broadcast_to(colours, (*_BAR, 3))
            kind = ", logarithmic" if scale.log else ""
            self._bar_ends.content = f"{scale.low:.4g} to {scale.high:.4g}{kind}"

    def _show_way(self) -> None:
        if self.way.value == self._drawn:  # overtaken by a later move of the slider
            return
        self._show_shapes()
        self._show_marks()
        self._show_picks()

    def _show_marks(self) -> None:
        for mark in self._marks:
            mark.remove()
        self._marks.clear()
        for side in (0, 1):
            if self.landmarks.value:
                self._add_landmarks(side)
            if self.seams.value:
                self._add_seams(side)

    def _add_landmarks(self, side: int) -> None:
        shape = self.scene.shapes[side]
        count = len(shape.landmarks)
        if count == 0:
            return
        hue = np.stack([np.arange(count) / count, np.ones(count), np.full(count, 0.9)], axis=1)
        ball = icosphere(subdivisions=2, radius=_LANDMARK_RADIUS)
        mark = self.server.scene.add_batched_meshes_simple(
            f"{_NODES[side]}/landmarks",
            ball.vertices,
            ball.faces,
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            batched_positions=self.shown[side][shape.landmarks] + self.scene.offsets[side],
            batched_colors=np.round(255 * hsv_to_rgb(hue)).astype(np.uint8),
        )
        self._marks.append(mark)

    def _add_seams(self, side: int) -> None:
        """A shape's own seam; on the target also the image of the source's."""
        source, target = self.scene.shapes
        shown = self.shown[side]
        lifted = shown + _LIFT * self.scene.shapes[side].normals(shown)
        if side == 0:
            lines = [("seam", lifted[source.seam], _SOURCE_SEAM)]
        else:
            image = self.scene.image + _LIFT * source.normals(self.scene.image)
            lines = [
                ("image", image[source.seam], _SOURCE_SEAM),
                ("seam", lifted[target.seam], _TARGET_SEAM),
            ]
        for name, points, colour in lines:
            if len(points):
                mark = self.server.scene.add_line_segments(
                    f"{_NODES[side]}/{name}",
                    points + self.scene.offsets[side],
                    colour,
                    thickness=_SEAM_WIDTH,
                )
                self._marks.append(mark)

    def _show_picks(self) -> None:
        for pair in self.markers.values():
            for marker in pair:
                marker.remove()
        self.markers = {
            colour: (self._marker(0, colour, found), self._marker(1, colour, found))
            for colour, found in self.picks.items()
        }
        self._list.content = "\n\n".join(
            _told(colour, found) for colour, found in reversed(self.picks.items())
        )

    def _marker(self, side: int, colour: str, found: Pick) -> Any:
        point = found.places[side].take(self.shown[side], self.scene.shapes[side].faces)[0]
        return self.server.scene.add_icosphere(
            f"{_NODES[side]}/{colour}",
            radius=_PICK_RADIUS,
            color=PICK_COLOURS[colour],
            position=point + self.scene.offsets[side],
        )


def _told(colour: str, found: Pick) -> str:
    """A pick in Markdown: where it is, in both shapes' own units, and the values there."""
    rows = [
        f"{'**picked**' if side == found.side else 'image'} | {_numbers(found.own[side])} "
        f"| {_numbers(found.uv[side])}"
        for side in (0, 1)
    ]
    head = f"**{colour}** | point | u, v\n---|---|---"
    values = "; ".join(f"{name} {value:.4g}" for name, value in found.values.items())
    return "\n".join([head, *rows]) + f"\n\n{values}"


def _numbers(values: np.ndarray) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


@contextlib.contextmanager
def serving(result: Result, host: str, port: int) -> Iterator[tuple[Viewer, str]]:
    """The viewer on a port until the block ends, and its address.

    Args:
        result: what :func:`nsm.load` gave.
        host: the address to listen on.
        port: 0 for any that is free.

    Raises:
        NsmError: viser is not installed, or the port or address cannot be used.
    """
    viser = needed("viser", "nsm view", "view")
    _check(host, port)
    with _quiet():
        server = viser.ViserServer(host=host, port=port, verbose=False)
    # a button of viser's page would put the server on the internet, through a service of others
    server.request_share_url = lambda *_, **__: None
    try:
        bound = server.get_port()
        if port not in (0, bound):  # taken since it was checked
            raise _in_use(port)
        name = f"[{host}]" if ":" in host else host
        yield Viewer(result, server), f"http://{name}:{bound}"
    finally:
        with _quiet():
            server.stop()


def _quiet() -> contextlib.redirect_stdout[io.StringIO]:
    """viser says at length where it listens, and that it has stopped."""
    return contextlib.redirect_stdout(io.StringIO())


def _check(host: str, port: int) -> None:
    """Whether one can listen there: viser would try a thousand other ports, and then hang."""
    if not 0 <= port < 2**16:
        raise NsmError(f"port {port}: there are those from 1 to 65535, and 0 for any that is free")
    try:
        kind, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(kind, socket.SOCK_STREAM) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(address)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise _in_use(port) from error
        raise NsmError(f"cannot listen on {host}, port {port}: {error.strerror}") from error


def _in_use(port: int) -> NsmError:
    return NsmError(f"port {port} is in use; give another, or --port 0 for any that is free")
