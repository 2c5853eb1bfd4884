"""``nsm landmarks``: place corresponding landmarks on meshes in the browser."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rich.console import Console

from nsm.arguments import Arguments
from nsm.commands import add_address
from nsm.errors import NsmError
from nsm.loading_libraries import loading_libraries
from nsm.optional_dependencies import needed
from nsm.stages import stage

if TYPE_CHECKING:
    from nsm.correspondence.landmark_list import LandmarkList
    from nsm.domains.joint_preparation import Mesh
    from nsm.results.view import EditedShape
    from nsm.surfaces.validation import CleanMesh


def main(arguments: list[str]) -> None:
    """Serve the editor until Ctrl-C.

    Raises:
        NsmError: wrong arguments, a mesh or file that cannot be read, ``file_exists``, or as
            :func:`nsm.results.view.running`.
        KeyboardInterrupt: Ctrl-C.
    """
    parser = Arguments(
        prog="nsm landmarks",
        description="Place corresponding landmarks on two meshes or more in the browser, side by "
        "side. Those that landmarks=auto would propose are there to begin with, where all meshes "
        "are closed and of genus 0.",
        epilog="Every task reads the file: nsm task=pair_map source=a.obj target=b.obj "
        "landmarks=pairs.json.",
    )
    parser.add_argument("mesh", nargs="+", metavar="MESH", help="a mesh file or a catalogue name")
    parser.add_argument(
        "--landmarks",
        nargs="+",
        metavar="FILE",
        help="begin with these: a file of all meshes, a file for each, or a folder, in any format "
        "that landmarks=... takes",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("pairs.json"),
        metavar="FILE",
        help="where they are saved; default: %(default)s",
    )
    parser.add_argument(
        "--parts",
        metavar="PART",
        help="of meshes of several parts: largest, or a number, 0 for the largest area, as "
        "surface.parts has it",
    )
    parser.add_argument(
        "--repair", choices=["split"], help="cut meshes apart at non-manifold edges"
    )
    parser.add_argument("--empty", action="store_true", help="begin without landmarks")
    parser.add_argument(
        "--check", action="store_true", help="begin with the coarse map of the landmarks"
    )
    add_address(parser)
    given = parser.parse_args(arguments)
    if len(given.mesh) < 2:
        raise NsmError("nsm landmarks: give two meshes or more", kind="bad_argument")
    if given.out.exists() and (given.landmarks or []) != [str(given.out)]:
        raise NsmError(
            f"{given.out}: exists; begin with it by --landmarks {given.out}, or give another --out",
            kind="file_exists",
            key=str(given.out),
        )
    part = _part(given.parts)
    needed("viser", "nsm landmarks", "view")
    # torch takes seconds to import, which --help and wrong options do not need
    with loading_libraries(frozen=True):
        from nsm.correspondence.landmark_list import LandmarkList
        from nsm.results.view import EditedShape, LandmarkEditor, running
        from nsm.surfaces.validation import Repairs

    meshes = [_mesh(name) for name in given.mesh]
    cleaned = [mesh.cleaned(Repairs(part, given.repair)) for mesh in meshes]
    shapes = [
        EditedShape(mesh.name, clean.vertices, clean.faces, clean.source_vertex)
        for mesh, clean in zip(meshes, cleaned, strict=True)
    ]
    if given.landmarks:
        landmarks = _given(given.landmarks, meshes, cleaned)
    else:
        landmarks = LandmarkList(len(shapes)) if given.empty else _proposed(shapes)
    with running("nsm landmarks", given.host, given.port) as (server, address):
        editor = LandmarkEditor(shapes, landmarks, given.out, server)
        if given.check:
            editor.check()
        print(f"{given.out}: {address} (Ctrl-C ends)", flush=True)
        while True:
            time.sleep(3600)


def _part(given: str | None) -> Literal["largest"] | int | None:
    """Which part of a mesh is kept."""
    if given is None:
        return None
    if given == "largest":
        return "largest"
    if not given.isdecimal():
        raise NsmError(
            f"--parts {given}: give largest, or a number from 0",
            kind="bad_argument",
            key="--parts",
        )
    return int(given)


def _mesh(name: str) -> Mesh:
    from nsm.domains import domain
    from nsm.domains.joint_preparation import Mesh
    from nsm.pipeline.resolve_inputs import read_shape

    mesh = read_shape(name, domain("disc"), "mesh")
    if not isinstance(mesh, Mesh):
        raise NsmError(f"{name}: no mesh; give a mesh file", kind="wrong_type", key=name)
    return mesh


def _given(files: list[str], meshes: list[Mesh], cleaned: list[CleanMesh]) -> LandmarkList:
    """The landmarks of files, in all formats of tasks, also those that one mesh alone has."""
    from nsm.correspondence.landmark_list import LandmarkList
    from nsm.pipeline.landmark_inputs import all_landmarks
    from nsm.surfaces.landmarks import as_vertices, kept_landmarks

    given = files if len(files) > 1 else files[0]
    lists, names = all_landmarks(given, [mesh.name for mesh in meshes])
    ids = []
    for mesh, clean, of_one in zip(meshes, cleaned, lists, strict=True):
        vertex = as_vertices(of_one, mesh.vertices, mesh.faces, mesh.name).vertex
        ids.append(kept_landmarks(clean, vertex, mesh.name))
    return LandmarkList(len(meshes), ids, names)


def _proposed(shapes: Sequence[EditedShape]) -> LandmarkList:
    """The landmarks that are proposed; none where nothing can be."""
    from nsm.correspondence import proposed_for_all
    from nsm.correspondence.landmark_list import LandmarkList

    console = Console(highlight=False)
    try:
        with stage(console, f"proposing landmarks of {', '.join(shape.name for shape in shapes)}"):
            found = proposed_for_all([(s.vertices, s.faces) for s in shapes])
    except NsmError as error:
        console.print(f"begins without landmarks: {error}", soft_wrap=True, markup=False)
        return LandmarkList(len(shapes))
    sure = "sure" if found.sure else "NOT SURE, check each"
    console.print(f"{len(found.vertices[0])} landmarks proposed, {sure}")
    return LandmarkList(len(shapes), list(found.vertices[0].T))
