"""Seams that users give: lists, files, lines of an OBJ file, borders of UV islands."""

import json

import numpy as np
import pytest
import trimesh

from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.atlas import packed
from nsm.surfaces.loading import load_mesh
from nsm.surfaces.seams import charts, kept_edges, read_seams
from nsm.surfaces.shapes import ring_mesh
from nsm.surfaces.validation import clean


def cube():
    """A cube of 12 triangles: vertices (8, 3), and faces (12, 3), two on each side."""
    mesh = trimesh.creation.box()
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def box_edges():
    """The 12 edges (12, 2) of the cube: those of its triangles that are no diagonals."""
    vertices, faces = cube()
    pairs = topology.edges_of(faces).pairs
    return pairs[
        np.isclose(np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1), 1)
    ]


def write_cube(file, lines=(), uv=None):
    vertices, faces = cube()
    rows = [f"v {x} {y} {z}" for x, y, z in vertices]
    if uv is None:
        rows += ["f {} {} {}".format(*(f + 1)) for f in faces]
    else:
        rows += [f"vt {u} {v}" for u, v in uv.reshape(-1, 2)]
        rows += [
            "f " + " ".join(f"{v + 1}/{3 * k + j + 1}" for j, v in enumerate(f))
            for k, f in enumerate(faces)
        ]
    file.write_text("\n".join([*rows, *lines]) + "\n")
    return file


def islands():
    """Texture coordinates (12, 3, 2) of the cube: each side is an island."""
    vertices, faces = cube()
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.abs(normal).argmax(axis=1)
    side = axis * 2 + (normal[np.arange(12), axis] > 0)
    flat = np.stack([np.delete(corners[k], axis[k], axis=1) for k in range(12)])
    return flat + 2 * side[:, None, None]


def area(part):
    return topology.face_areas(part.vertices, part.faces).sum()


def as_set(pairs):
    return {tuple(sorted(pair)) for pair in np.asarray(pairs).tolist()}


def test_every_form_names_the_same_edges(tmp_path):
    _, faces = cube()
    edges = box_edges()
    (tmp_path / "seams.json").write_text(json.dumps(edges.tolist()))
    (tmp_path / "seams.txt").write_text("# from, to\n" + "\n".join(f"{a}, {b}" for a, b in edges))
    marked = [f"l {a + 1} {b + 1}" for a, b in edges[:-1]]
    marked.append(f"l {edges[-1][0] - 8} {edges[-1][1] - 8}")  # back from the last vertex
    mesh = write_cube(tmp_path / "cube.obj", marked, islands())
    assert np.array_equal(load_mesh(mesh)[1], faces)
    for given in (edges, edges.tolist(), tmp_path / "seams.json", tmp_path / "seams.txt"):
        assert as_set(read_seams(given, None, faces, "cube")) == as_set(edges)
    for given in ("lines", "uv"):
        assert as_set(read_seams(given, mesh, faces, "cube")) == as_set(edges)


def test_a_cube_falls_into_its_sides_or_stays_one_chart():
    vertices, faces = cube()
    mesh = clean(vertices, faces)
    edges = kept_edges(box_edges(), mesh)
    sides = charts(mesh, edges, "cube")
    assert [area(part) for part in sides] == pytest.approx([1] * 6)
    for part in sides:
        known = part.origin >= 0  # the diagonals are split
        assert np.array_equal(part.vertices[known], mesh.vertices[part.origin[known]])
    # a net: a spanning tree of the edges leaves one disc, of the same area
    tree, joined = [], list(range(8))
    for a, b in edges.tolist():
        if joined[a] != joined[b]:
            tree.append((a, b))
            joined = [joined[b] if k == joined[a] else k for k in joined]
    (net,) = charts(mesh, np.array(tree), "cube")
    assert topology.is_disc(net.faces) and area(net) == pytest.approx(6)
    # a ring of edges leaves a disc and, closed up to it, another
    bottom = [e for e in edges if (mesh.vertices[e][:, 2] < 0).all()]
    assert [area(part) for part in charts(mesh, np.array(bottom), "cube")] == pytest.approx([5, 1])
    # seams that open nothing: what is still closed is cut further
    (rest,) = charts(mesh, edges[:0], "cube")
    assert topology.is_disc(rest.faces)


@pytest.mark.parametrize(
    ("given", "kind"),
    [
        ([[0, 7]], "not_an_edge"),
        ([[0, 99]], "not_an_edge"),
        ([[0.5, 1]], "wrong_type"),
        ([0, 1], "wrong_type"),
        (3, "wrong_type"),
        ("lines", "no_seams"),
        ("uv", "missing_uv"),
        ("nowhere.txt", "missing_file"),
        ("bad.txt", "damaged_file"),
    ],
)
def test_other_seams_are_refused(tmp_path, monkeypatch, given, kind):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.txt").write_text("0 1\nhere there\n")
    mesh = write_cube(tmp_path / "cube.obj")
    with pytest.raises(NsmError) as refused:
        read_seams(given, mesh, cube()[1], "cube")
    assert refused.value.kind == kind and "\n" not in str(refused.value)


def test_packed_charts_keep_shape_and_scale_and_do_not_overlap():
    rng = np.random.default_rng(0)
    flat = []
    for size in (1.0, 0.5, 2.0, 0.3):
        uv, faces = ring_mesh(4)
        flat.append((uv * [size, 2 * size] + rng.normal(size=2), faces))
    places, scale = packed(flat)
    boxes = []
    for (uv, _), place in zip(flat, places, strict=True):
        assert place.min() >= 0 and place.max() <= 1
        assert np.allclose(place - place[0], scale * (uv - uv[0]))
        boxes.append((place.min(axis=0), place.max(axis=0)))
    for k, (low, high) in enumerate(boxes):  # ellipses: their boxes may meet at corners only
        for other, (below, above) in enumerate(boxes[:k]):
            room = np.minimum(high, above) - np.maximum(low, below)
            if (room > 0).all():
                near = np.linalg.norm(places[k][:, None] - places[other][None], axis=2).min()
                assert near > 1 / 1024
