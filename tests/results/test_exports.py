"""What a map leaves for other programs: units, vertices and faces are those of the files."""

import json
import struct

import numpy as np
import pytest
import trimesh
from scipy.sparse import csr_matrix
from tiny import dome, results

import nsm
from nsm.errors import NsmError
from nsm.results import (
    NeuralSurface,
    SurfaceMap,
    export_surface,
    write_correspondences,
    write_reliability,
)
from nsm.results.file_faces import faces_of_file
from nsm.results.morph_target import write_morph_target
from nsm.surfaces.gltf import check_gltf
from nsm.surfaces.validation import Repairs

NEURAL, _, PAIR, _ = results(rings=5)


def ball(scale, centre, seed):
    """A surface of a sphere's file, with its faces in any order, cut for the disc."""
    mesh = trimesh.creation.icosphere(subdivisions=2)
    order = np.random.default_rng(seed).permutation(len(mesh.faces))
    faces = np.roll(mesh.faces[order], seed, axis=1)
    surface = nsm.Surface.from_arrays(scale * mesh.vertices + centre, faces, name=f"ball {seed}")
    return NeuralSurface(surface, NEURAL[0].map)


@pytest.fixture(scope="module")
def cut():
    """A map between spheres of other places and units, each cut by itself."""
    ends = ball(10.0, [100.0, 0, 0], 1), ball(0.1, [0, -5.0, 0], 2)
    return SurfaceMap(*ends, PAIR.map, np.array([[0, 0]]))


def read_glb(path):
    """The tree of a GLB file, and its accessors as arrays, by the specification."""
    data = path.read_bytes()
    magic, version, length = struct.unpack("<4sII", data[:12])
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack("<I4s", data[12:20])
    assert kind == b"JSON" and size % 4 == 0
    tree = json.loads(data[20 : 20 + size])
    rest = data[20 + size :]
    binary, kind = struct.unpack("<I4s", rest[:8])
    assert kind == b"BIN\0" and binary == len(rest) - 8 == tree["buffers"][0]["byteLength"]
    arrays = []
    for accessor in tree["accessors"]:
        view = tree["bufferViews"][accessor["bufferView"]]
        begin = 8 + view["byteOffset"]
        assert view["byteOffset"] % 4 == 0 and view["byteLength"] % 4 == 0
        dtype = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
        columns = {"SCALAR": 1, "VEC3": 3}[accessor["type"]]
        raw = np.frombuffer(rest[begin : begin + view["byteLength"]], dtype)
        arrays.append(raw.reshape(accessor["count"], columns))
        if "min" in accessor:
            assert np.array_equal(arrays[-1].min(axis=0), np.array(accessor["min"], "f4"))
            assert np.array_equal(arrays[-1].max(axis=0), np.array(accessor["max"], "f4"))
    return tree, arrays


def test_a_morph_target_leads_from_the_source_to_the_target(cut, tmp_path):
    file = tmp_path / "morph.glb"
    cut.export_morph(file)
    tree, arrays = read_glb(file)
    primitive = tree["meshes"][0]["primitives"][0]
    middle = np.array(tree["nodes"][0]["translation"])
    start = arrays[primitive["attributes"]["POSITION"]] + middle
    vertices, faces = cut.source.file_mesh()
    np.testing.assert_array_equal(arrays[primitive["indices"]].reshape(-1, 3), faces)
    np.testing.assert_allclose(start, vertices, rtol=0, atol=1e-6)  # 100 from the origin
    end = start + arrays[primitive["targets"][0]["POSITION"]]
    away = np.linalg.norm(end - [0, -5.0, 0], axis=1)
    assert 0.08 < away.min() <= away.max() < 0.1001  # on the small sphere, in its place
    assert tree["meshes"][0]["extras"]["targetNames"] == ["on ball 2"]
    channel = tree["animations"][0]["channels"][0]["target"]
    assert channel == {"node": 0, "path": "weights"}
    check_gltf(file)
    mesh = trimesh.load(file, force="mesh", process=False)
    np.testing.assert_array_equal(mesh.faces, faces)
    np.testing.assert_allclose(mesh.vertices, vertices, rtol=1e-6)
    with pytest.raises(NsmError) as caught:
        cut.export_morph(tmp_path / "morph.obj")
    assert caught.value.kind == "unknown_format"
    with pytest.raises(NsmError) as caught:
        write_morph_target(file, vertices, 1e39 * vertices, faces, "too far")
    assert caught.value.kind == "out_of_range"


def test_the_gltf_validator_finds_nothing(cut, tmp_path, gltf_issues):
    cut.export_morph(tmp_path / "morph.glb")
    assert gltf_issues(tmp_path) == {"morph.glb": []}


def test_meshes_are_written_as_they_came(cut, tmp_path):
    s = cut.source.surface
    vertices, faces = cut.source.file_mesh()
    own, corners = faces_of_file(s)
    np.testing.assert_array_equal(own, faces)
    np.testing.assert_array_equal(s.source_vertex[corners], faces)
    export_surface(tmp_path / "a.obj", cut.source.in_original_units(s.vertices), s, s.uv)
    mesh = trimesh.load(tmp_path / "a.obj", process=False, maintain_order=True)
    lines = (tmp_path / "a.obj").read_text().splitlines()
    rows = [[int(c.split("/")[0]) - 1 for c in x.split()[1:]] for x in lines if x[:2] == "f "]
    np.testing.assert_array_equal(rows, faces)
    points = [[float(c) for c in x.split()[1:]] for x in lines if x[:2] == "v "]
    np.testing.assert_allclose(points, vertices, rtol=1e-7)
    assert mesh.visual.uv.min() >= 0 and mesh.visual.uv.max() <= 1


def test_the_stored_correspondences_are_those_of_the_map(cut, tmp_path):
    write_correspondences(tmp_path / "c.npz", cut)
    stored = np.load(tmp_path / "c.npz")
    vertices, faces = cut.target.file_mesh()
    corners = stored["source_to_target_vertices"]
    assert np.array_equal(corners, faces[stored["source_to_target_face"]])
    image = (vertices[corners] * stored["source_to_target_barycentric"][:, :, None]).sum(axis=1)
    expected = cut.target.in_original_units(cut.welded_image)
    np.testing.assert_allclose(image, expected, atol=1e-9)
    back = stored["target_to_source_vertices"]
    weights = stored["target_to_source_barycentric"]
    rows = np.repeat(np.arange(len(back)), 3)
    shape = len(vertices), len(cut.source.file_mesh()[0])
    matrix = csr_matrix((weights.ravel(), (rows, back.ravel())), shape=shape)
    assert abs(matrix - cut.matrix()).max() == 0


def test_reliability_is_that_of_a_stretched_plane():
    """z = 0 over the disc, and the same twice as wide in its file: every figure is known."""
    flat = [dome(0.0, 5) for _ in range(2)]
    wide = nsm.Surface.from_arrays(2 * flat[1].raw[0], flat[1].raw[1])
    ends = [NeuralSurface(surface, NEURAL[0].map) for surface in (flat[0], wide)]
    same = flat[0].uv.copy()
    f = SurfaceMap(*ends, PAIR.map, np.array([[0, 0]]), vertex_image=same)
    distortion, stretch, away = f.reliability
    np.testing.assert_allclose(distortion, 4, atol=0.02)  # symmetric Dirichlet with its ε
    np.testing.assert_allclose(stretch, 2)
    vertices = ends[0].file_mesh()[0]
    direct = np.linalg.norm(vertices - vertices[0], axis=1)
    assert away[0] == 0 and (away >= direct - 1e-12).all() and (away <= 1.5 * direct + 1e-12).all()
    assert np.isinf(SurfaceMap(*ends, PAIR.map, np.zeros((0, 2), int)).reliability[2]).all()
    # a vertex drawn across its neighbours turns triangles around it and them alone
    centre = int(flat[0].cut_vertex[0])
    moved = same.copy()
    moved[centre] += [0.35, 0.0]
    broken = SurfaceMap(*ends, PAIR.map, f.landmarks, vertex_image=moved)
    flipped = broken.reliability.stretch < 0
    assert flipped[0]
    around = flat[0].raw[1][(flat[0].raw[1] == 0).any(axis=1)]
    assert set(np.flatnonzero(flipped)) <= set(around.ravel().tolist())


def test_reliability_is_written_at_the_vertices_of_the_file(cut, tmp_path):
    write_reliability(tmp_path / "reliability.ply", cut)
    mesh = trimesh.load(tmp_path / "reliability.ply", process=False)
    vertices, faces = cut.source.file_mesh()
    np.testing.assert_array_equal(mesh.faces, faces)
    np.testing.assert_allclose(mesh.vertices, vertices)
    data = mesh.metadata["_ply_raw"]["vertex"]["data"]
    for name, values in cut.reliability._asdict().items():
        assert np.array_equal(data[name].ravel(), values)


def test_points_over_filled_holes_go_to_the_nearest_face_of_the_file(cut):
    mesh = trimesh.creation.icosphere(subdivisions=2)
    faces = mesh.faces[~(mesh.faces == 40).any(axis=1)]
    vertices = np.asarray(mesh.vertices)
    surface = nsm.Surface.from_arrays(vertices, faces, repairs=Repairs("largest", None, 9))
    f = SurfaceMap(NeuralSurface(surface, NEURAL[0].map), cut.target, PAIR.map, cut.landmarks)
    assert surface.filled.any()
    np.testing.assert_array_equal(faces_of_file(surface)[0], faces)
    origin = f.correspondences(back=True).take(vertices, faces)
    t = f.target.surface
    once = np.setdiff1d(np.arange(len(t.cut_vertex)), t.source_vertex[t.seam_pairs.ravel()])
    off = np.linalg.norm(origin - f.inverse(f.target.file_mesh()[0]), axis=1)[once]
    assert np.quantile(off, 0.8) < 1e-6 and off.max() < 0.3  # over the hole, at its rim
    distortion, stretch, _ = f.reliability
    assert np.isnan(distortion[40]) and np.isnan(stretch[40])
    assert np.isfinite(np.delete(distortion, 40)).all()
    values, functions = f.source.spectrum(3)
    assert abs(values[0]) < 1e-6 and len(functions) == len(vertices)
