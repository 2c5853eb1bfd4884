"""Base colours of the materials that OBJ, PLY and glTF files name."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from nsm.surfaces.folder_files import read_below
from nsm.surfaces.gltf import check_images, check_textures
from nsm.surfaces.loading import check_file, error_in, is_number

# The base colour of a material, (H, W, C) uint8, which is read when it is called: an image that is
# missing is no error for a mesh of which only the coordinates are wanted.
Paint = Callable[[], np.ndarray]

LARGEST_IMAGE = 2**30  # bytes
_GREY = 204  # of faces without a material, the 0.8 of most programs
# how many words follow an option of map_Kd, where it is not one
_OPTIONS = {"-mm": 2, "-o": 3, "-s": 3, "-t": 3}
_NEUTRAL = {"-o": 0.0, "-s": 1.0, "-t": 0.0}  # of these there may be fewer


def plain(colour: Sequence[float] = (_GREY,) * 3) -> Paint:
    """An image of one texel, of a colour (3,) or (4,) in [0, 255]."""
    texel = np.rint(np.clip(colour, 0, 255)).astype(np.uint8).reshape(1, 1, -1)
    return lambda: texel


def same_channels(images: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Images (H, W, 3) or (H, W, 4), all with alpha if one has it."""
    if all(image.shape[2] == 3 for image in images):
        return tuple(images)
    padding = ((0, 0), (0, 0), (0, 1))
    return tuple(
        image if image.shape[2] == 4 else np.pad(image, padding, constant_values=255)
        for image in images
    )


def read_image(file: Path) -> np.ndarray:
    """An image file as (H, W, 3), or (H, W, 4) if it is transparent somewhere, uint8.

    Raises:
        NsmError: ``missing_file``, ``unreadable_file``, ``not_a_file`` or ``file_too_large``. The
            key is the path.
    """
    check_file(file, LARGEST_IMAGE)
    return _decoded(file.read_bytes(), file)


def _decoded(data: bytes | Any, name: object) -> np.ndarray:
    try:
        picture = Image.open(io.BytesIO(data)) if isinstance(data, bytes) else data
        if picture.mode[:1] in ("I", "F"):
            raise ValueError("it has more than 8 bits for a colour")
        see_through = picture.mode in ("RGBA", "LA", "PA") or "transparency" in picture.info
        pixels = np.asarray(picture.convert("RGBA" if see_through else "RGB"))
    except UnidentifiedImageError as error:  # its own words name an object in memory
        reason = "no image; give a PNG or JPEG file"
        raise error_in(name, "unreadable_file", reason) from error
    except Exception as error:  # Pillow raises any exception on damaged files
        cause = " ".join(str(error).split())[:100] or type(error).__name__
        reason = f"not a readable image ({cause}); save it as PNG or JPEG"
        raise error_in(name, "unreadable_file", reason) from error
    return pixels[:, :, :3] if see_through and (pixels[:, :, 3] == 255).all() else pixels


def _beside(mesh: Path, name: str) -> np.ndarray:
    """An image that a mesh file names, in its folder or below, or of that name beside it.

    Programs write the paths of the machine they ran on.
    """
    words = name.replace("\\", "/")
    for candidate in (words, words.rsplit("/", 1)[-1]):
        try:
            return _decoded(read_below(mesh.parent, candidate), mesh.parent / candidate)
        except ValueError:
            continue
    raise error_in(
        mesh.parent / words,
        "missing_file",
        f"the image of {mesh.name}, not in its folder; copy it there or give texture=FILE",
    )


def read_libraries(mesh: Path, names: Sequence[str]) -> dict[str, Paint]:
    """The materials by name of the material files that an OBJ file names; missing files have none.

    ``Kd`` colours a material without ``map_Kd``.
    """
    colours: dict[str, Paint] = {}
    for name in names:
        # a name may have spaces, and there may be several names
        for one in [name] if (mesh.parent / name).is_file() else name.split():
            try:
                data = read_below(mesh.parent, one.replace("\\", "/"))
            except ValueError:
                continue
            colours.update(_materials(mesh, data.decode("utf-8-sig", errors="replace")))
    return colours


def _materials(mesh: Path, text: str) -> dict[str, Paint]:
    flat: dict[str, Paint] = {}
    images: dict[str, Paint] = {}
    name = ""
    for line in text.splitlines():
        fields = line.split("#")[0].split()
        word = fields[0].lower() if fields else ""
        if word == "newmtl":
            name = line.split(None, 1)[1].strip() if len(fields) > 1 else ""
            flat.setdefault(name, plain())
        elif word == "kd" and len(fields) == 4:
            try:
                flat[name] = plain([255 * float(field) for field in fields[1:]])
            except ValueError:
                continue
        elif word == "map_kd" and len(fields) > 1:
            images[name] = partial(_mapped, mesh, line.split(None, 1)[1].strip())
    return {**flat, **images}


def _mapped(mesh: Path, words: str) -> np.ndarray:
    """The image of a line map_Kd, after its options."""
    while words.startswith("-"):
        option, *rest = words.split(None, 1)
        words = rest[0] if rest else ""
        for _ in range(_OPTIONS.get(option, 1)):
            first, *rest = words.split(None, 1) or [""]
            if option in _NEUTRAL:
                if not is_number(first):
                    break
                if float(first) != _NEUTRAL[option]:
                    raise error_in(
                        mesh,
                        "unsupported_texture",
                        f"its material moves the image (map_Kd {option}); apply that to the UV",
                    )
            words = rest[0] if rest else ""
    return _beside(mesh, words)


def of_ply(comments: Sequence[str], mesh: Path) -> Paint:
    """The image that the comment ``TextureFile`` of a PLY file names."""
    for comment in comments:
        word, _, name = comment.strip().partition(" ")
        if word.lower() == "texturefile" and name.strip():
            return partial(_beside, mesh, name.strip())
    return plain()


def of_gltf(mesh: Path, material: Any) -> Paint:
    """The base colour of a material of a glTF file, as trimesh has it.

    A factor multiplies the image in linear light, as the format says.
    """

    def paint() -> np.ndarray:
        for check, kind in (
            (check_images, "missing_file"),
            (check_textures, "unsupported_texture"),
        ):
            try:
                check(mesh)
            except ValueError as error:
                raise error_in(mesh, kind, f"{error}; export it again") from error
        picture = getattr(material, "baseColorTexture", None)
        factor = getattr(material, "baseColorFactor", None)
        linear = np.ones(4) if factor is None else np.asarray(factor, dtype=np.float64) / 255
        if picture is None:
            texel = [*_encoded(linear[:3]), 255 * linear[3]]
            return plain(texel if linear[3] < 1 else texel[:3])()
        pixels = _decoded(picture, mesh)
        if (linear == 1).all():
            return pixels
        if pixels.shape[2] == 3 and linear[3] < 1:
            pixels = same_channels([pixels, np.zeros((1, 1, 4), np.uint8)])[0]
        table = np.stack([_encoded(_decoded_light(np.arange(256)) * f) for f in linear[:3]], 1)
        table = np.column_stack([table, np.arange(256) * linear[3]])
        channels = range(pixels.shape[2])
        return np.stack([np.rint(table[pixels[..., k], k]) for k in channels], -1).astype(np.uint8)

    return plain() if material is None else paint


def _decoded_light(srgb: np.ndarray) -> np.ndarray:
    """Linear light in [0, 1] of sRGB values in [0, 255] (IEC 61966-2-1)."""
    c = srgb / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def _encoded(linear: np.ndarray) -> np.ndarray:
    """sRGB values in [0, 255] of linear light in [0, 1]."""
    return 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
