"""Textures that a map carries: the colours of preimages, without seams, in files that read back."""

import functools

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from thorough import examples
from tiny import NETWORK, planar, stirred

from nsm.domains import Surface
from nsm.errors import NsmError
from nsm.maps import NeuralMap
from nsm.results import NeuralSurface, SurfaceMap
from nsm.results.baking import atlas_fault, baked, charts, padded, rim_texels, texels
from nsm.results.file_faces import FileFaces
from nsm.results.rasteriser import rasterise
from nsm.results.render import View
from nsm.results.textured_mesh import FileMesh, TexturedMesh, painted
from nsm.surfaces.atlas import unwrapped
from nsm.surfaces.geometry import point_mesh_distance, triangle_distortion
from nsm.surfaces.loading import load_mesh
from nsm.surfaces.location import Places, locate
from nsm.surfaces.shapes import ring_mesh
from nsm.surfaces.textures import Texture, bilinear, read_texture, read_uv

MAGENTA = np.array([255, 0, 255])  # of the background, a colour that no chart has


def bumpy(seed: int, subdivisions: int = 3) -> trimesh.Trimesh:
    """A closed shape without symmetry."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    waves = np.random.default_rng(seed).normal(size=(4, 3))
    ball.vertices *= (1 + 0.08 * np.sin(2 * ball.vertices @ waves.T).sum(axis=1))[:, None]
    return ball


def smooth(points: np.ndarray) -> np.ndarray:
    """Colours (N, 3) that vary smoothly in space, without pure magenta."""
    return 128 + 90 * np.sin(0.5 * points + [0.3, 1.1, 2.0])


def coloured(mesh: FileMesh, size: int, *, background: bool = False) -> Texture:
    """A mesh with the smooth colours in an atlas, on magenta if asked."""
    uv = unwrapped(mesh.vertices, mesh.faces, size=size)

    def colours(face, weights):
        return smooth(Places(face, weights).take(mesh.vertices, mesh.faces))

    if not background:
        return Texture(uv, (baked(uv, colours, size),), np.zeros(len(uv), int))
    image = np.tile(MAGENTA, (size * size, 1)).astype(np.uint8)
    shown = texels(uv, size)
    image[shown.texel] = np.rint(colours(shown.face, shown.weights))
    return Texture(uv, (image.reshape(size, size, 3),), np.zeros(len(uv), int))


class Case:
    """Two meshes and a map between them, over the domain of that name."""

    def __init__(self, domain: str) -> None:
        self.meshes = []
        for seed in (0, 1):
            ball = bumpy(seed)
            vertices, faces = np.asarray(ball.vertices) * 10 + 3, np.asarray(ball.faces)
            self.meshes.append(FileMesh(f"m{seed}", vertices, faces))
        network = stirred(NeuralMap(out_dim=3, **NETWORK))
        ends = [
            NeuralSurface(Surface.from_arrays(m.vertices, m.faces, domain=domain), network)
            for m in self.meshes
        ]
        if domain == "disc":
            h = planar()
        else:
            h = stirred(ends[0].surface.domain.equivariant(NeuralMap(out_dim=2, **NETWORK)))
        self.f = SurfaceMap(*ends, h, np.zeros((0, 2), int))


@functools.cache
def case(domain: str) -> Case:
    return Case(domain)


def drawn(count: int, faces: int, seed: int = 0) -> Places:
    random = np.random.default_rng(seed)
    return Places(random.integers(0, faces, count), random.dirichlet(np.ones(3), count))


def test_textured_glb_files_are_valid(tmp_path, valid_gltf):
    end = case("disc").meshes[1]
    uv = unwrapped(end.vertices, end.faces, size=64)
    for name, channels in (("opaque", 3), ("transparent", 4)):
        image = np.full((64, 64, channels), 128, np.uint8)
        TexturedMesh(end.vertices, end.faces, uv, image).export(tmp_path / f"{name}.glb")
    assert valid_gltf(tmp_path) == {"opaque.glb", "transparent.glb"}


@pytest.mark.parametrize("back", [False, True])
@pytest.mark.parametrize("domain", ["disc", "orbifold"])
def test_a_point_has_the_colour_of_its_preimage(domain, back):
    """A point of the source, its image by f itself, and what the baked image shows there."""
    c = case(domain)
    start, end = c.meshes[::-1] if back else c.meshes
    mesh = painted(c.f, start, coloured(start, 512), end, back=back, size=1024)
    if back:  # points of the source, and their images on the target
        there = drawn(3000, len(end.faces)).take(end.vertices, end.faces)
        colours_of = c.f(there)
    else:
        colours_of = drawn(3000, len(start.faces)).take(start.vertices, start.faces)
        there = c.f(colours_of)
    assert point_mesh_distance(there, end.vertices, end.faces).max() < 1e-6
    at = locate(there, end.vertices, end.faces)
    shown = bilinear(mesh.image, np.einsum("nk,nkd->nd", at.weights, mesh.uv[at.face]))
    error = np.abs(shown - smooth(colours_of)).max(axis=1)
    # one side of the surfaces' seam may be stretched; nearly all points agree to rounding
    assert np.quantile(error, 0.98) < 4 and np.median(error) < 1.5


def test_a_picture_of_the_target_shows_the_colours_of_preimages(tmp_path):
    """The files are read by trimesh, drawn, and each pixel's preimage found by f on its own."""
    c = case("disc")
    start, end = c.meshes
    painted(c.f, start, coloured(start, 512), end).export(tmp_path / "t.glb")
    back = trimesh.load(tmp_path / "t.glb", process=False, force="mesh")
    view = View(back.vertices, 200)
    turned = back.vertices @ view.frame.T
    flat = (turned[:, :2] - view.center[:2]) / view.half
    xy = np.stack([flat[:, 0] + 1, 1 - flat[:, 1]], axis=1) * 100
    _, face, weights = rasterise(xy, turned[:, 2], back.faces, 200)
    places = Places(face, weights)
    pixels = bilinear(
        np.asarray(back.visual.material.baseColorTexture), places.take(back.visual.uv, back.faces)
    )
    # the image of a dense sample of the source: each pixel's preimage is near the nearest of it
    sample = drawn(200_000, len(start.faces)).take(start.vertices, start.faces)
    image = c.f(sample)
    from scipy.spatial import cKDTree

    distance, nearest = cKDTree(image).query(places.take(back.vertices, back.faces))
    close = distance < 0.1  # of a shape 20 across
    assert close.mean() > 0.7
    error = np.abs(pixels - smooth(sample[nearest])).max(axis=1)[close]
    assert np.quantile(error, 0.95) < 8


def test_neither_atlas_shows_its_background():
    """Lookups at the very borders of charts, of the source on magenta and of the target."""
    c = case("disc")
    start, end = c.meshes
    loud = coloured(start, 256, background=True)
    along = np.linspace(0, 1, 9)[:, None]
    rims = [np.roll(np.column_stack([along, 1 - along, 0 * along]), k, axis=1) for k in range(3)]

    def leaks(texture: Texture, faces: int) -> int:
        """How many lookups along the sides of faces have some magenta: much red and blue."""
        place = np.repeat(np.arange(faces), 9)
        found = [texture.colours(place, np.tile(rim, (faces, 1))) for rim in rims]
        value = np.concatenate(found)
        return int((value[:, [0, 2]].min(axis=1) > 222).sum())

    assert leaks(loud, len(start.faces)) > 100  # the test can fail
    assert leaks(padded(loud), len(start.faces)) == 0
    mesh = painted(c.f, start, loud, end, size=256)
    target = Texture(mesh.uv, (mesh.image,), np.zeros(len(mesh.uv), int))
    assert leaks(target, len(end.faces)) == 0


def test_colours_agree_on_both_sides_of_the_seams_of_an_atlas():
    mesh = case("disc").meshes[0]
    texture = coloured(mesh, 512)
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    order = np.lexsort(edges.T)
    pairs = order.reshape(-1, 2)  # closed: each edge has two faces
    assert (edges[pairs[:, 0]] == edges[pairs[:, 1]]).all()
    seen = []
    for side in pairs.T:
        face = side // 3
        weights = 0.5 * (mesh.faces[face][:, :, None] == edges[side][:, None, :]).any(axis=2)
        seen.append(texture.colours(face, weights))
    assert np.abs(seen[0] - seen[1]).max() < 6


@examples(15)
@given(st.integers(2, 12), st.integers(8, 80), st.integers(0, 10**6))
def test_every_texel_that_lookups_reach_is_known(rings, size, seed):
    points, faces = ring_mesh(rings)
    random = np.random.default_rng(seed)
    turn = np.linalg.qr(random.normal(size=(2, 2)))[0]  # mirrored or not
    uv = (0.5 + 0.45 * points @ turn.T)[faces]
    inside, rim = texels(uv, size), rim_texels(uv, size)
    assert len(np.intersect1d(inside.texel, rim.texel)) == 0
    for shown in (inside, rim):
        centre = np.stack([shown.texel % size, shown.texel // size], axis=1) + 0.5
        found = np.einsum("nk,nkd->nd", shown.weights, uv[shown.face]) * [size, size]
        off = np.linalg.norm(found * [1, -1] + [0, size] - centre, axis=1)
        assert off.max(initial=0) < (1e-9 if shown is inside else 6)
    at = drawn(500, len(uv), seed)
    place = np.einsum("nk,nkd->nd", at.weights, uv[at.face]) * size
    low = np.floor(np.stack([place[:, 0], size - place[:, 1]], axis=1) - 0.5).astype(int)
    reached = [(low + [i, j]).clip(0, size - 1) @ [1, size] for i in (0, 1) for j in (0, 1)]
    assert np.isin(np.concatenate(reached), np.concatenate([inside.texel, rim.texel])).all()


@examples(10)
@given(st.integers(0, 10**6))
def test_colours_linear_in_the_image_are_kept(seed):
    points, faces = ring_mesh(5)
    uv = (0.5 + 0.4 * points)[faces]
    slope = np.random.default_rng(seed).uniform(0, 120, (2, 3))
    image = baked(uv, lambda f, w: np.einsum("nk,nkd->nd", w, uv[f]) @ slope, 128)
    at = drawn(500, len(uv), seed)
    place = np.einsum("nk,nkd->nd", at.weights, uv[at.face])
    inner = np.linalg.norm(place - 0.5, axis=1) < 0.38
    assert np.abs(bilinear(image, place) - place @ slope)[inner].max() <= 1


# ------------------------------------------------------------------ faces of files


@pytest.mark.parametrize("domain", ["disc", "orbifold"])
def test_places_go_to_the_file_and_back(domain):
    c = case(domain)
    mesh, surface = c.meshes[0], c.f.source.surface
    faces = FileFaces(surface, mesh.vertices, mesh.faces, "m")
    there = drawn(2000, len(mesh.faces))
    points = there.take(mesh.vertices, mesh.faces)
    inside = faces.to_surface(there)
    on_surface = c.f.source.in_original_units(inside.take(surface.vertices, surface.faces))
    assert np.abs(on_surface - points).max() < 1e-9
    again = faces.to_file(inside)
    assert np.abs(again.take(mesh.vertices, mesh.faces) - points).max() < 1e-9
    assert (again.face == there.face).mean() > 0.98  # others are split by the seam


def test_faces_that_the_surface_lacks_take_the_nearest_point():
    """Debris is removed, and duplicates are merged, before a surface is laid out."""
    vertices, faces = ring_mesh(6)
    vertices = np.column_stack([vertices, 0 * vertices[:, 0]])
    debris = np.array([[0.1, 0.1, 0.3], [0.11, 0.1, 0.3], [0.1, 0.11, 0.3]])
    twice = np.concatenate([vertices, debris, vertices])
    faces = np.concatenate(
        [faces[:10] + len(vertices) + 3, faces[10:], np.array([[0, 1, 2]]) + len(vertices)]
    )
    surface = Surface.from_arrays(twice, faces)
    link = FileFaces(surface, twice, faces, "m")
    there = drawn(1000, len(faces))
    points = there.take(twice, faces)
    found = link.to_surface(there)
    on_surface = found.take(surface.vertices, surface.faces) / surface.scale + surface.center
    kept = there.face < len(faces) - 1
    assert np.abs(on_surface - points)[kept].max() < 1e-9
    assert np.allclose(on_surface[~kept], points[~kept] * [1, 1, 0])


def test_another_mesh_is_refused():
    c = case("disc")
    start, end = c.meshes
    for wrong in (FileMesh("w", start.vertices + 1, start.faces), FileMesh("w", *ring(4))):
        with pytest.raises(NsmError) as caught:
            painted(c.f, wrong, coloured(start, 64), end, size=64)
        assert (caught.value.kind, caught.value.key) == ("wrong_mesh", "w")


def ring(rings):
    points, faces = ring_mesh(rings)
    return np.column_stack([points, 0 * points[:, 0]]), faces


# ------------------------------------------------------------------ atlases


def test_atlases_are_little_distorted_and_do_not_overlap():
    mesh = bumpy(3)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    uv = unwrapped(vertices, faces)
    assert uv.shape == (len(faces), 3, 2) and uv.min() >= 0 and uv.max() <= 1
    assert atlas_fault(uv, vertices[faces], 1024) is None
    flat = np.pad(uv.reshape(-1, 2), ((0, 0), (0, 1)))
    area = 0.5 * np.linalg.norm(np.cross(flat[1::3] - flat[::3], flat[2::3] - flat[::3]), axis=1)
    assert area.sum() > 0.3
    scale = np.sqrt(mesh.area / area.sum())
    soup = np.arange(3 * len(faces)).reshape(-1, 3)
    energy = triangle_distortion(vertices[faces].reshape(-1, 3), scale * flat, soup)
    assert np.median(energy) < 4.1 and np.quantile(energy, 0.95) < 5


def test_the_size_and_place_of_a_mesh_do_not_change_its_atlas():
    mesh = bumpy(2)
    for scale, shift in ((1e-4, 0.0), (1e4, 1e5)):
        uv = unwrapped(mesh.vertices * scale + shift, mesh.faces)
        assert atlas_fault(uv, mesh.triangles, 1024) is None
    with pytest.raises(NsmError) as caught:
        unwrapped(np.zeros((3, 3)), np.array([[0, 1, 2]]), name="point")
    assert (caught.value.kind, caught.value.key) == ("not_unwrapped", "point")


def test_a_target_keeps_its_own_coordinates_where_they_are_an_atlas():
    c = case("disc")
    start, end = c.meshes
    texture = coloured(start, 64)
    own = unwrapped(end.vertices, end.faces, size=128)
    for uv, kept in ((own, True), (own + 0.5, False), (own % 0.5, False), (0 * own, False)):
        given_ = FileMesh("end", end.vertices, end.faces, uv)
        mesh = painted(c.f, start, texture, given_, size=64)
        assert np.array_equal(mesh.uv, uv) == kept and len(mesh.log) == 1


def test_charts_are_faces_with_coordinates_in_common():
    uv = ring(3)[0][:, :2][ring(3)[1]]
    both = np.concatenate([uv, uv + 10])
    assert (charts(both) == np.repeat([0, 1], len(uv))).all()


def test_faces_at_one_colour_of_a_palette_keep_it():
    image = np.zeros((8, 8, 3), np.uint8)
    image[:, :4], image[:, 4:] = [255, 0, 0], [0, 0, 255]
    uv = np.tile([[0.2, 0.5]], (2, 3, 1)).reshape(2, 3, 2)
    uv[1] = [[0.6, 0.1], [0.95, 0.1], [0.95, 0.9]]
    texture = padded(Texture(uv, (image,), np.zeros(2, int)))
    shown = texture.colours(np.array([0, 1]), np.full((2, 3), 1 / 3))
    assert (shown == [[255, 0, 0], [0, 0, 255]]).all()


# ------------------------------------------------------------------ files


@pytest.mark.parametrize("channels", [3, 4])
def test_files_give_back_what_was_written(tmp_path, channels):
    c = case("disc")
    end = c.meshes[1]
    uv = unwrapped(end.vertices, end.faces, size=64)
    image = np.random.default_rng(0).integers(0, 255, (64, 64, channels)).astype(np.uint8)
    mesh = TexturedMesh(end.vertices, end.faces, uv, image)
    mesh.export(tmp_path / "m.obj")
    vertices, faces, _ = load_mesh(tmp_path / "m.obj")
    assert (vertices == end.vertices).all() and (faces == end.faces).all()
    assert np.abs(read_uv(tmp_path / "m.obj") - uv).max() < 1e-8
    assert (read_texture(tmp_path / "m.obj").images[0] == image).all()
    mesh.export(tmp_path / "m.glb")
    texture = read_texture(tmp_path / "m.glb")
    vertices, faces, _ = load_mesh(tmp_path / "m.glb")
    assert np.abs(vertices[faces] - end.vertices[end.faces]).max() < 1e-4
    assert np.abs(texture.uv - uv).max() < 1e-6 and (texture.images[0] == image).all()
    with pytest.raises(NsmError) as caught:
        mesh.export(tmp_path / "m.stl")
    assert caught.value.kind == "unknown_format"
