"""The viewer's server and panel. The other modules of this package compute what it shows."""

from __future__ import annotations

import contextlib
import errno
import io
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from trimesh.creation import icosphere

from nsm.errors import NsmError
from nsm.optional_dependencies import needed
from nsm.results.collection import SurfaceCollection
from nsm.results.render import UP_AXES, axis_of
from nsm.results.view.colours import distinct_colours
from nsm.results.view.glb import painted_glb
from nsm.results.view.picking import Pick, pick
from nsm.results.view.scene import Shown, scene_of

Result = Shown | SurfaceCollection

_NODES = "/source", "/target"
_PICKS = 5  # the latest, on both shapes; a new one replaces the oldest
_SOURCE_SEAM, _TARGET_SEAM = (255, 120, 0), (0, 150, 200)
# in normalized units: every surface has the area of Ω
_PICK_RADIUS, _LANDMARK_RADIUS, _SEAM_WIDTH, _LIFT = 0.03, 0.014, 0.01, 0.004
_BAR = (12, 256)


class Viewer:
    """The result of a run in the browser.

    Args:
        result: from :func:`nsm.load`.
        server: a ``viser.ViserServer``.
    """

    def __init__(self, result: Result, server: Any) -> None:
        self.result, self.server = result, server
        self.picks: dict[int, Pick] = {}  # by their numbers from 1, oldest first
        self.markers: dict[int, tuple[Any, Any]] = {}
        self._overlays: list[Any] = []
        self._lock = threading.RLock()  # viser runs callbacks in several threads
        self._pair = [0, 1]
        self.scene = scene_of(self._current(), axis_of(result.config))
        self._build_panel()
        self._show_scene()
        server.scene.on_click()(self.on_click)

    def _current(self) -> Shown:
        if isinstance(self.result, SurfaceCollection):
            return self.result.pair(*self._pair)
        return self.result

    @property
    def shown(self) -> tuple[np.ndarray, np.ndarray]:
        """The current vertices (V, 3) of both shapes, without the scene's offsets."""
        return self.scene.morph(self.morph.value), self.scene.target.vertices

    def on_click(self, event: Any) -> None:
        """Mark the point under the mouse and the corresponding one."""
        with self._lock:
            ray = np.array(event.ray_origin), np.array(event.ray_direction)
            found = pick(self.scene, *ray, self.shown)
            if found is None:
                return
            number = max(self.picks, default=0) + 1
            if len(self.picks) == _PICKS:
                self.picks.pop(min(self.picks))
            self.picks[number] = found
            self._show_picks()

    def _build_panel(self) -> None:
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        self.ends: list[Any] = []
        if isinstance(self.result, SurfaceCollection):
            names = [f"{k}: {phi.surface.name}" for k, phi in enumerate(self.result.surfaces)]
            for side, end in enumerate(("source", "target")):
                choice = gui.add_dropdown(end, names, initial_value=names[self._pair[side]])
                choice.on_update(self._locked(partial(self._choose_pair, side)))
                self.ends.append(choice)
        names = self.scene.colourings
        self.colouring = gui.add_dropdown("colours", names, initial_value=names[0])
        self._bar = gui.add_image(np.zeros((*_BAR, 3), dtype=np.uint8), visible=False)
        self._bar_ends = gui.add_markdown("", visible=False)
        self.up = gui.add_dropdown("up", list(UP_AXES), initial_value=axis_of(self.result.config))
        self.morph = gui.add_slider(
            "morph", 0.0, 1.0, 0.02, 0.0, hint="moves the left shape to its image"
        )
        self.landmarks = gui.add_checkbox("landmarks", bool(len(self.scene.source.landmarks)))
        self.seams = gui.add_checkbox("seams", False)
        gui.add_markdown("Click a shape to mark a point and its image on the other shape.")
        clear = gui.add_button("clear points")
        self._list = gui.add_markdown("")
        self.colouring.on_update(self._locked(self._show_shapes))
        self.up.on_update(self._locked(self._rebuild))
        self.morph.on_update(self._locked(self._show_morph))
        self.landmarks.on_update(self._locked(self._show_overlays))
        self.seams.on_update(self._locked(self._show_overlays))
        clear.on_click(self._locked(self._clear_picks))

    def _locked(self, act: Callable[[], None]) -> Callable[[Any], None]:
        def call(_: Any) -> None:
            with self._lock:
                act()

        return call

    def _choose_pair(self, side: int) -> None:
        """Show another pair of the collection; choosing the same surface twice swaps the two."""
        chosen = [choice.options.index(choice.value) for choice in self.ends]
        if chosen == self._pair:
            return
        if chosen[0] == chosen[1]:
            chosen[1 - side] = self._pair[side]
        self._pair = chosen
        for choice, k in zip(self.ends, chosen, strict=True):
            choice.value = choice.options[k]
        self.picks.clear()
        self._rebuild()

    def _clear_picks(self) -> None:
        self.picks.clear()
        self._show_picks()

    def _rebuild(self) -> None:
        self.scene = scene_of(self._current(), self.up.value)
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
        self._show_overlays()
        self._show_picks()

    def _show_shapes(self) -> None:
        self._drawn = self.morph.value
        name = self.colouring.value
        for node, shape, vertices, paint, offset in zip(
            _NODES,
            self.scene.shapes,
            self.shown,
            self.scene.paint(name),
            self.scene.offsets,
            strict=True,
        ):
            data = painted_glb(shape, vertices, paint)
            self.server.scene.add_glb(f"{node}/mesh", data, position=offset)
        scale = self.scene.scale(name)
        self._bar.visible = self._bar_ends.visible = scale is not None
        if scale is not None:
            colours = np.round(255 * scale.bar(_BAR[1])).astype(np.uint8)
            self._bar.image = np.broadcast_to(colours, (*_BAR, 3))
            kind = ", logarithmic" if scale.log else ""
            self._bar_ends.content = f"{scale.low:.4g} to {scale.high:.4g}{kind}"

    def _show_morph(self) -> None:
        if self.morph.value == self._drawn:  # already drawn
            return
        self._show_shapes()
        self._show_overlays()
        self._show_picks()

    def _show_overlays(self) -> None:
        for mark in self._overlays:
            mark.remove()
        self._overlays.clear()
        for side in (0, 1):
            if self.landmarks.value:
                self._show_landmarks(side)
            if self.seams.value:
                self._show_seams(side)

    def _show_landmarks(self, side: int) -> None:
        shape = self.scene.shapes[side]
        count = len(shape.landmarks)
        if count == 0:
            return
        ball = icosphere(subdivisions=2, radius=_LANDMARK_RADIUS)
        mark = self.server.scene.add_batched_meshes_simple(
            f"{_NODES[side]}/landmarks",
            ball.vertices,
            ball.faces,
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            batched_positions=self.shown[side][shape.landmarks] + self.scene.offsets[side],
            batched_colors=distinct_colours(count),
        )
        self._overlays.append(mark)

    def _show_seams(self, side: int) -> None:
        """Draw a shape's seam, and on the target also the image of the source's."""
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
                self._overlays.append(mark)

    def _show_picks(self) -> None:
        for pair in self.markers.values():
            for marker in pair:
                marker.remove()
        self.markers = {
            number: (self._marker(0, number, found), self._marker(1, number, found))
            for number, found in self.picks.items()
        }
        names = [shape.name for shape in self.scene.shapes]
        self._list.content = "\n\n".join(
            _markdown(number, found, names) for number, found in reversed(self.picks.items())
        )

    def _marker(self, side: int, number: int, found: Pick) -> Any:
        point = found.places[side].take(self.shown[side], self.scene.shapes[side].faces)[0]
        node = f"{_NODES[side]}/point{number}"
        colour = distinct_colours(_PICKS)[(number - 1) % _PICKS]
        marker = self.server.scene.add_icosphere(
            node,
            radius=_PICK_RADIUS,
            color=tuple(colour.tolist()),
            position=point + self.scene.offsets[side],
        )
        self.server.scene.add_label(
            f"{node}/number", str(number), position=(0, 1.5 * _PICK_RADIUS, 0)
        )
        return marker


def _markdown(number: int, found: Pick, names: Sequence[str]) -> str:
    """A pick as Markdown: both points by the names of their shapes, and the values there."""
    rows = [
        f"{_cell(name)}{' (picked)' if side == found.side else ''} "
        f"| {'–' if found.vertices[side] < 0 else found.vertices[side]} "
        f"| {_numbers(found.coordinates[side])} | {_numbers(found.uv[side])}"
        for side, name in enumerate(names)
    ]
    head = f"**{number}** | vertex | point | u, v\n---|---|---|---"
    values = "; ".join(f"{name} {value:.4g}" for name, value in found.values.items())
    return "\n".join([head, *rows]) + f"\n\n{values}"


def _cell(text: str) -> str:
    """A text within a table of Markdown, whatever is in it."""
    return "".join(c if c.isalnum() or c in " .:-" else f"\\{c}" for c in text)


def _numbers(values: np.ndarray) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


@contextlib.contextmanager
def serving(result: Result, host: str, port: int) -> Iterator[tuple[Viewer, str]]:
    """Serve the viewer until the block ends; gives the viewer and its address.

    Args:
        result: from :func:`nsm.load`.
        host, port: as for :func:`running`.

    Raises:
        NsmError: as :func:`running`.
    """
    with running("nsm view", host, port) as (server, address):
        yield Viewer(result, server), address


@contextlib.contextmanager
def running(command: str, host: str, port: int) -> Iterator[tuple[Any, str]]:
    """A ``viser.ViserServer`` until the block ends, and its address.

    Args:
        command: that needs it, for messages.
        host: the address to listen on.
        port: 0 for any free port.

    Raises:
        NsmError: viser is not installed, ``out_of_range`` or ``port_in_use`` (key ``port``), or
            ``address_not_available`` (key ``host``).
    """
    viser = needed("viser", command, "view")
    _check_address(host, port)
    with _silenced():
        server = viser.ViserServer(host=host, port=port, verbose=False)
    # a button of viser's page would publish the server on the internet
    server.request_share_url = lambda *_, **__: None
    try:
        bound = server.get_port()
        if port not in (0, bound):  # another process took it after the check
            raise _in_use(port)
        name = f"[{host}]" if ":" in host else host
        yield server, f"http://{name}:{bound}"
    finally:
        with _silenced():
            server.stop()


def _silenced() -> contextlib.redirect_stdout[io.StringIO]:
    """Hide viser's messages about starting and stopping."""
    return contextlib.redirect_stdout(io.StringIO())


def _check_address(host: str, port: int) -> None:
    """Raise an error if viser cannot listen there: it would try other ports and then hang."""
    if not 0 <= port < 2**16:
        reason = f"port {port}: give a number from 1 to 65535, or 0 for any free port"
        raise NsmError(reason, kind="out_of_range", key="port")
    try:
        kind, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(kind, socket.SOCK_STREAM) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(address)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise _in_use(port) from error
        reason = f"cannot listen on {host}, port {port}: {error.strerror}; give another --host"
        raise NsmError(reason, kind="address_not_available", key="host") from error


def _in_use(port: int) -> NsmError:
    reason = f"port {port} is in use; give another one, or --port 0 for any free port"
    return NsmError(reason, kind="port_in_use", key="port")
