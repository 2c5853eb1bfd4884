"""Texture coordinates and images of mesh files, compared with trimesh and with closed forms."""

import json
import shutil

import numpy as np
import pytest
import trimesh
from PIL import Image

from nsm.errors import NsmError
from nsm.surfaces.loading import load_mesh
from nsm.surfaces.textures import Texture, bilinear, read_texture, read_uv

# a picture whose colours are linear in (u, v), but for rounding: red grows with u, green with v
SIZE = 64
RAMP = np.zeros((SIZE, SIZE, 3), dtype=np.uint8)
RAMP[..., 0] = np.rint(np.linspace(0, 255, SIZE))[None, :]
RAMP[..., 1] = np.rint(np.linspace(255, 0, SIZE))[:, None]


def ramp_at(uv):
    """What a lookup of RAMP gives away from the picture's border."""
    return np.clip((uv * SIZE - 0.5) / (SIZE - 1), 0, 1) * 255


QUADS = """mtllib q.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 2 0 0
v 2 1 0
vt 0.1 0.1
vt 0.5 0.1
vt 0.5 0.9
vt 0.1 0.9
vt 0.9 0.1
vt 0.9 0.9
usemtl skin
f 1/1 2/2 3/3 4/4
f 2/-5 5/5 6/6 3/-4
"""


@pytest.fixture
def quads(tmp_path):
    """Two quads, of which the second counts its texture coordinates from the end."""
    (tmp_path / "q.obj").write_text(QUADS)
    (tmp_path / "q.mtl").write_text("newmtl skin\nKd 1 1 1\nmap_Kd -s 1 1 1 some skin.png\n")
    Image.fromarray(RAMP).save(tmp_path / "some skin.png")
    return tmp_path / "q.obj"


def ball(subdivisions=2):
    """A sphere with UV that has a seam, as trimesh needs it: vertices doubled along the seam."""
    mesh = trimesh.creation.uv_sphere(count=[12, 16])
    soup = mesh.vertices[mesh.faces.reshape(-1)]
    uv = np.stack([np.arctan2(soup[:, 1], soup[:, 0]) / (2 * np.pi) % 1, 0.5 + 0.4 * soup[:, 2]], 1)
    faces = np.arange(len(soup)).reshape(-1, 3)
    visual = trimesh.visual.TextureVisuals(
        uv=uv,
        material=trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(RAMP)),
    )
    return trimesh.Trimesh(soup, faces, visual=visual, process=False)


def refused(function, *given):
    with pytest.raises(NsmError) as caught:
        function(*given)
    assert "\n" not in str(caught.value)
    return caught.value.kind, caught.value.key


def test_corners_are_those_of_the_loader(quads):
    vertices, faces, _ = load_mesh(quads)
    uv = read_uv(quads)
    assert uv.shape == (4, 3, 2) and len(faces) == 4
    # in this file u and v are linear in x and y
    assert np.allclose(uv[..., 0], 0.1 + 0.4 * vertices[faces][..., 0])
    assert np.allclose(uv[..., 1], 0.1 + 0.8 * vertices[faces][..., 1])


def test_colours_are_interpolated_in_the_picture(quads):
    texture = read_texture(quads)
    random = np.random.default_rng(0)
    face, weights = random.integers(0, 4, 200), random.dirichlet(np.ones(3), 200)
    uv = np.einsum("nk,nkd->nd", weights, texture.uv[face])
    assert np.abs(texture.colours(face, weights)[:, :2] - ramp_at(uv)).max() < 1


@pytest.mark.parametrize("ending", ["glb", "gltf"])
def test_a_gltf_file_gives_what_was_put_in(tmp_path, ending):
    mesh = ball()
    mesh.export(tmp_path / f"ball.{ending}")
    vertices, faces, _ = load_mesh(tmp_path / f"ball.{ending}")
    texture = read_texture(tmp_path / f"ball.{ending}")
    assert np.allclose(vertices[faces], mesh.triangles, atol=1e-6)
    assert np.allclose(texture.uv, mesh.visual.uv[mesh.faces], atol=1e-6)
    assert len(texture.images) == 1 and (texture.images[0] == RAMP).all()


@pytest.mark.parametrize("per_face", [False, True])
def test_ply_files_have_coordinates_at_vertices_or_corners(tmp_path, per_face):
    corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
    words = ["ply", "format ascii 1.0", "comment TextureFile skin.png", "element vertex 4"]
    words += [f"property float {name}" for name in ("x", "y", "z", "s", "t")]
    words += ["element face 1", "property list uchar int vertex_indices"]
    words += ["property list uchar float texcoord"] * per_face + ["end_header"]
    words += [f"{x} {y} 0 {0.5 * x} {0.5 * y}" for x, y in corners]
    quarter = " ".join(f"{0.25 * x} {0.25 * y}" for x, y in corners)
    words += ["4 0 1 2 3" + f" 8 {quarter}" * per_face]
    file = tmp_path / "q.ply"
    file.write_text("\n".join(words) + "\n")
    vertices, faces, _ = load_mesh(file)
    assert np.allclose(read_uv(file), (0.25 if per_face else 0.5) * vertices[faces][..., :2])
    assert refused(read_texture, file) == ("missing_file", str(tmp_path / "skin.png"))
    Image.fromarray(RAMP).save(tmp_path / "skin.png")
    assert (read_texture(file).images[0] == RAMP).all()


def test_another_image_takes_the_place_of_the_file_s(quads, tmp_path):
    Image.fromarray(255 - RAMP).save(tmp_path / "other.png")
    assert (read_texture(quads, tmp_path / "other.png").images[0] == 255 - RAMP).all()


def test_materials_in_one_colour_and_images_go_together(quads, tmp_path):
    (tmp_path / "q.mtl").write_text(
        "newmtl skin\nmap_Kd C:\\old\\some skin.png\nnewmtl red\nKd 1 0 0\n"
    )
    quads.write_text(QUADS.replace("f 2/-5 5/5 6/6 3/-4", "usemtl red\nf 2 5 6 3"))
    texture = read_texture(quads)
    colours = texture.colours(np.array([0, 3]), np.full((2, 3), 1 / 3))
    assert (colours[1] == [255, 0, 0]).all() and colours[0, 1] > 0
    assert read_uv(quads) is None


def test_transparent_and_grey_images(quads, tmp_path):
    clear = np.dstack([RAMP, np.full((SIZE, SIZE), 128, np.uint8)])
    Image.fromarray(clear).save(tmp_path / "clear.png")
    assert (read_texture(quads, tmp_path / "clear.png").images[0] == clear).all()
    Image.fromarray(RAMP[..., 0]).save(tmp_path / "grey.png")
    assert (read_texture(quads, tmp_path / "grey.png").images[0] == RAMP[..., :1]).all()


def test_a_factor_multiplies_the_image_in_linear_light(tmp_path):
    mesh = ball()
    mesh.visual.material.baseColorFactor = [0.5, 1.0, 1.0, 1.0]
    mesh.export(tmp_path / "ball.glb")
    pixels = read_texture(tmp_path / "ball.glb").images[0].astype(float) / 255
    light = np.where(RAMP > 10, (RAMP / 255 + 0.055) / 1.055, 0) ** 2.4
    want = 1.055 * (128 / 255 * light[..., 0]) ** (1 / 2.4) - 0.055
    bright = RAMP[..., 0] > 60
    assert np.abs(pixels[..., 0] - want)[bright].max() < 1.5 / 255
    assert np.abs(pixels[..., 1] * 255 - RAMP[..., 1]).max() <= 1


def test_lookups_repeat_and_hold_at_texel_centres():
    random = np.random.default_rng(1)
    image = random.integers(0, 256, (5, 7, 3))
    rows, columns = np.indices((5, 7))
    centre = np.stack([(columns + 0.5) / 7, 1 - (rows + 0.5) / 5], -1).reshape(-1, 2)
    for shift in ([0, 0], [3, -2]):
        assert np.allclose(bilinear(image, centre + shift), image.reshape(-1, 3))
    across = bilinear(image, np.array([[1.0, 1 - 0.5 / 5]]))  # between the last and first column
    assert np.allclose(across, 0.5 * (image[0, 0] + image[0, -1]))


def test_what_is_missing_is_named(quads, tmp_path):
    shutil.move(tmp_path / "some skin.png", tmp_path / "gone.png")
    assert refused(read_texture, quads) == ("missing_file", str(tmp_path / "some skin.png"))
    assert read_uv(quads) is not None  # which needs no image
    assert refused(read_texture, quads, tmp_path / "none.png")[0] == "missing_file"
    (tmp_path / "text.png").write_text("no image")
    assert refused(read_texture, quads, tmp_path / "text.png") == (
        "unreadable_file",
        str(tmp_path / "text.png"),
    )
    (tmp_path / "q.mtl").unlink()
    assert refused(read_texture, quads) == ("missing_texture", str(quads))
    bare = tmp_path / "bare.obj"
    trimesh.creation.box().export(bare)
    assert read_uv(bare) is None
    assert refused(read_texture, bare, tmp_path / "gone.png") == ("missing_uv", str(bare))
    trimesh.creation.box().export(tmp_path / "box.stl")
    assert refused(read_texture, tmp_path / "box.stl")[0] == "missing_uv"
    for words, kind in (("-s 2 2 1 gone.png", "unsupported_texture"), ("gone.png", None)):
        (tmp_path / "q.mtl").write_text(f"newmtl skin\nmap_Kd {words}\n")
        if kind:
            assert refused(read_texture, quads) == (kind, str(quads))
        else:
            assert isinstance(read_texture(quads), Texture)


def test_images_outside_the_folder_are_not_read(quads, tmp_path):
    Image.fromarray(RAMP).save(tmp_path.parent / "secret.png")
    (tmp_path / "q.mtl").write_text("newmtl skin\nmap_Kd ../secret.png\n")
    assert refused(read_texture, quads)[0] == "missing_file"


def test_gltf_images_that_trimesh_leaves_out_are_refused(tmp_path):
    ball().export(tmp_path / "ball.gltf")
    words = json.loads((tmp_path / "ball.gltf").read_text())
    images = [image.get("uri") for image in words["images"]]
    plain = json.dumps(words)
    texture = words["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    texture["extensions"] = {"KHR_texture_transform": {"scale": [2, 2]}}
    (tmp_path / "ball.gltf").write_text(json.dumps(words))
    assert refused(read_texture, tmp_path / "ball.gltf")[0] == "unsupported_texture"
    words = json.loads(plain)
    words["images"] = [{"uri": "gone.png"} for _ in images]
    (tmp_path / "ball.gltf").write_text(json.dumps(words))
    assert refused(read_texture, tmp_path / "ball.gltf")[0] == "missing_file"


@pytest.mark.parametrize("line", ["vt nan nan", "vt x y", "vt", "vt 1e300 0"])
def test_damaged_coordinates_leave_the_mesh_readable(tmp_path, line):
    file = tmp_path / "m.obj"
    file.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\n{line}\nf 1/1 2/1 3/0\nf 1/7 2/-9 3/x\n")
    assert len(load_mesh(file)[1]) == 2
    assert read_uv(file) is None
