"""Every public function and method with arbitrary arguments: a right result or NsmError.

``PROPERTIES`` names the tests of each; a public name without one fails.
"""

import copy
import inspect
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import pytorch_lightning as pl
import torch
import trimesh
from hydra.core.config_store import ConfigStore
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from thorough import examples
from tiny import NETWORK, planar, results, stirred

import nsm
from nsm import api, cli, extensions
from nsm.config import compose_config
from nsm.domains import Surface
from nsm.domains.planar_mesh import signed_areas
from nsm.errors import NsmError
from nsm.instantiation import made
from nsm.maps import ANALYTIC, BLOCKS, NeuralMap, as_activation, build_analytic
from nsm.results import NeuralSurface, Parameterization, SurfaceCollection, SurfaceMap
from nsm.results.metrics import evaluate
from nsm.results.textured_mesh import TexturedMesh
from nsm.surfaces import catalogue_names
from nsm.surfaces.location import Places

NEURAL, FLAT, PAIR, TRIO = results(rings=3)
VERTICES = len(NEURAL[0].surface.vertices)
INNER = 19  # vertices that are not on the rim

_DTYPES = st.sampled_from([np.float64, np.float32, np.int32, np.int64, bool, complex, "U2"])
_SHAPES = arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)
ANY_ARRAY = arrays.arrays(_DTYPES, _SHAPES)
ANY_FLOAT = st.floats() | st.sampled_from([0.0, 1e300, -1e300, 1e-300, math.nan, math.inf])


def rows_of(columns: int) -> st.SearchStrategy[np.ndarray]:
    """Arrays (N, columns) of all kinds of floats, small ones more often."""
    shape = st.tuples(st.integers(0, 5), st.just(columns))
    return arrays.arrays(np.float64, shape, elements=ANY_FLOAT) | arrays.arrays(
        np.float64, shape, elements=st.floats(-2, 2)
    )


def usable(array: np.ndarray, columns: int) -> bool:
    real = array.dtype.kind in "fiub"
    return real and array.ndim == 2 and array.shape[1] == columns and np.isfinite(array).all()


# ------------------------------------------------------------------ results take points


def check_points(function: Callable, array: np.ndarray, columns: int, out: tuple[int, ...]) -> None:
    """Points (N, columns) give finite (N, *out), anything else NsmError."""
    try:
        result = function(array)
    except NsmError as error:
        assert not usable(array, columns) and "\n" not in str(error)
        return
    assert usable(array, columns) and result.shape == (len(array), *out)
    if np.abs(array, dtype=np.float64).max(initial=0) < 1e30:
        assert np.isfinite(result).all()


@examples(40)
@given(ANY_ARRAY | rows_of(2))
def test_functions_of_the_domain(array):
    check_points(NEURAL[0], array, 2, (3,))
    check_points(NEURAL[0].jacobian, array, 2, (3, 2))
    check_points(lambda uv: NEURAL[0].value_and_jacobian(uv)[0], array, 2, (3,))
    check_points(FLAT, array, 2, (2,))
    check_points(PAIR.planar, array, 2, (2,))


@examples(40)
@given(ANY_ARRAY | rows_of(3))
def test_functions_of_space(array):
    check_points(PAIR, array, 3, (3,))
    check_points(PAIR.inverse, array, 3, (3,))
    check_points(lambda p: PAIR.value_and_jacobian(p)[1], array, 3, (3, 3))
    check_points(PAIR.aligned, array, 3, (3,))
    check_points(NEURAL[0].in_original_units, array, 3, (3,))


@pytest.fixture(scope="module")
def painted_files(tmp_path_factory) -> Path:
    """The domes 0 and 1 as OBJ files: the first with texture coordinates and an image."""
    folder = tmp_path_factory.mktemp("painted")
    for k in (0, 1):
        s = NEURAL[k].surface
        vertices = NEURAL[k].in_original_units(s.vertices)
        faces, image = s.faces, np.full((8, 8, 3), 100, np.uint8)
        mesh = TexturedMesh(vertices, faces, (0.5 + 0.4 * s.uv)[faces], image)
        mesh.export(folder / f"{k}.obj")
    (folder / "1.mtl").unlink()
    return folder


@examples(25)
@given(
    *[st.sampled_from(["0.obj", "1.obj", "0.png", "none.obj", "sphere", ""])] * 2,
    st.none() | st.sampled_from(["0.png", "0.obj", "none.png"]),
    st.booleans(),
    st.integers(-1, 9) | st.sampled_from([2**40, True, 1.5, None]),
)
def test_what_is_baked(painted_files, source, target, texture, back, size):
    ends = [painted_files / name if "." in name else name for name in (source, target)]
    image = None if texture is None else painted_files / texture
    try:
        mesh = PAIR.bake(*ends, texture=image, back=back, size=size)
    except NsmError as error:
        good = texture == "0.png" or texture is None and not back
        fits = isinstance(size, int) and not isinstance(size, bool) and 1 <= size <= 8192
        assert "\n" not in str(error)
        assert not (good and fits and (source, target) == ("0.obj", "1.obj"))
        return
    assert mesh.image.shape == (size, size, 3) and (mesh.image == 100).all()
    assert len(mesh.uv) == len(mesh.faces)


@examples(20)
@given(st.integers(0, 10**6), st.booleans())
def test_places_are_those_of_points(seed, back):
    random = np.random.default_rng(seed)
    s, t = PAIR.source.surface, PAIR.target.surface
    start, end = (t, s) if back else (s, t)
    given_ = Places(random.integers(0, len(start.faces), 20), random.dirichlet(np.ones(3), 20))
    found = PAIR.places(given_, back=back)
    again = PAIR.places(found, back=not back)
    assert np.allclose(found.weights.sum(axis=1), 1) and (found.weights >= 0).all()
    there, here = (p.take(start.uv, start.faces) for p in (again, given_))
    inner = np.linalg.norm(here, axis=1) < 0.8  # the rim's polygons differ by their arcs
    assert np.allclose(there[inner], here[inner], atol=1e-9)
    if not back:
        points = PAIR.source.in_original_units(given_.take(s.vertices, s.faces))
        images = PAIR.target.in_original_units(found.take(end.vertices, end.faces))
        assert np.allclose(PAIR(points), images, atol=1e-9)


@examples(30)
@given(ANY_ARRAY)
def test_functions_of_tensors(array):
    if array.dtype.kind == "U":
        return
    tensor = torch.from_numpy(array.copy())
    for columns, functions in (
        (2, (NEURAL[0], NEURAL[0].jacobian, NEURAL[0].to("cpu"))),
        (3, (PAIR, PAIR.inverse, PAIR.module(), PAIR.to("cpu"))),
    ):
        fits = tensor.ndim == 2 and tensor.shape[1] == columns and tensor.is_floating_point()
        for function in functions:
            try:
                result = function(tensor)
            except NsmError:
                assert not fits or columns == 3 and not tensor.isfinite().all()
            else:
                assert fits and result.dtype == tensor.dtype and len(result) == len(tensor)


@examples(20)
@given(rows_of(2))
def test_modules_give_what_their_maps_give(uv):
    tensor = torch.from_numpy(uv)
    phi, module = NEURAL[0], NEURAL[0].module()
    for one, other in zip(
        module.value_and_jacobian(tensor), phi.value_and_jacobian(tensor), strict=True
    ):
        assert torch.equal(one.nan_to_num(), other.nan_to_num())
    inside = uv[(np.abs(uv) < 2).all(axis=1)]
    points = phi(inside)
    given_ = torch.from_numpy(points)
    assert np.allclose(PAIR.module()(given_).numpy(), PAIR(points), atol=1e-6)
    assert np.allclose(PAIR.to("cpu")(points), PAIR(points), atol=1e-12)
    # of a flattening, the network: at the vertices what a call gives, elsewhere smooth
    h, vertices = FLAT.module().requires_grad_(True), FLAT.phi.surface.uv
    assert np.allclose(h(torch.from_numpy(vertices)).detach(), FLAT(vertices), atol=1e-6)
    value, slopes = h.value_and_jacobian(tensor.requires_grad_())
    for k in range(2):
        (gradient,) = torch.autograd.grad(value[:, k].sum(), tensor, retain_graph=True)
        torch.testing.assert_close(gradient, slopes[:, k], equal_nan=True)
    value.sum().backward()
    assert not any(p.requires_grad for p in FLAT.map.parameters())


@examples(5)
@given(st.booleans(), st.sampled_from(["a.glb", "b.GLB", "c.obj", "d"]))
def test_correspondences_and_morphs_are_on_the_files(tmp_path_factory, back, name):
    start, end = (PAIR.target, PAIR.source) if back else (PAIR.source, PAIR.target)
    face, weights = PAIR.correspondences(back=back)
    vertices, faces = end.file_mesh()
    assert len(face) == len(weights) == len(start.file_mesh()[0])
    assert (weights >= 0).all() and np.allclose(weights.sum(axis=1), 1)
    points = Places(face, weights).take(vertices, faces)
    expected = (PAIR.inverse if back else PAIR)(start.file_mesh()[0])
    assert np.allclose(points, expected, atol=1e-6)
    file = tmp_path_factory.mktemp("morph") / name
    try:
        PAIR.export_morph(file)
    except NsmError as error:
        assert error.kind == "unknown_format" and not file.exists()
    else:
        assert file.suffix.lower() == ".glb" and file.read_bytes()[:4] == b"glTF"


@examples(30)
@given(
    arrays.arrays(np.float64, st.tuples(st.integers(1, 8), st.just(2)), elements=st.floats(-1, 1))
)
def test_jacobians_are_differences(uv):
    phi, eps = NEURAL[0], 1e-3
    step = eps * np.eye(2)
    slopes = [(phi(uv + step[k]) - phi(uv - step[k])) / (2 * eps) for k in (0, 1)]
    assert np.allclose(phi.jacobian(uv), np.stack(slopes, axis=2), atol=1e-2)


@examples(30)
@given(
    arrays.arrays(np.float64, st.tuples(st.integers(1, 8), st.just(2)), elements=st.floats(-1, 1))
)
def test_points_keep_to_the_target_and_units_come_back(uv):
    inside = uv / np.maximum(1, np.linalg.norm(uv, axis=1, keepdims=True))
    assert (np.linalg.norm(PAIR.planar(inside), axis=1) <= 1 + 1e-9).all()
    s = NEURAL[0].surface
    points = evaluate(NEURAL[0].map, inside)
    assert np.allclose(NEURAL[0].in_original_units(points), NEURAL[0](inside), atol=1e-12)
    assert np.allclose((NEURAL[0](inside) - s.center) * s.scale, points, atol=1e-12)


@examples(40)
@given(
    st.one_of(
        ANY_ARRAY,
        arrays.arrays(np.float64, (VERTICES, 2), elements=ANY_FLOAT),
        arrays.arrays(np.float64, VERTICES, elements=st.floats(-1, 1)),
        arrays.arrays(np.int64, VERTICES, elements=st.integers(0, 3)),
    ),
    st.booleans(),
)
def test_transfer(values, back):
    try:
        carried = PAIR.transfer(values, back=back)
    except NsmError:
        numbers = values.dtype.kind in "fiubc" and np.isfinite(values).all()
        assert not (numbers and values.ndim and len(values) >= VERTICES)
        return
    assert carried.shape == values.shape
    if carried.size:
        room = 1e-9 * np.abs(values).max()
        assert values.min() - room <= carried.min() <= carried.max() <= values.max() + room
    if values.dtype.kind in "ib":
        assert set(np.unique(carried)) <= set(np.unique(values)) and carried.dtype == values.dtype


@examples(20)
@given(arrays.arrays(np.float64, (VERTICES, 2), elements=st.floats(-1e6, 1e6)))
def test_the_matrix_transfers(values):
    matrix = PAIR.matrix()
    np.testing.assert_allclose(matrix @ values, PAIR.transfer(values), atol=1e-6)
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0)
    assert matrix.min() >= -1e-12


@examples(10)
@given(st.integers(-1, 50) | st.none() | st.floats())
def test_spectra(count):
    try:
        values, functions = NEURAL[0].spectrum(count)
    except NsmError:
        assert type(count) is not int or not 1 <= count < VERTICES
        return
    assert values.shape == (count,) and functions.shape == (VERTICES, count)
    assert abs(values[0]) < 1e-6 and (np.diff(values) > -1e-9).all()


@examples(30)
@given(ANY_FLOAT | st.integers(-2, 2) | st.none() | st.text(max_size=2) | st.complex_numbers())
def test_morph(t):
    try:
        vertices = PAIR.morph(t)
    except NsmError:
        assert not isinstance(t, (int, float)) or not math.isfinite(t)
        return
    assert vertices.shape == (VERTICES, 3)
    if t == 0:
        assert (vertices == PAIR.source.file_mesh()[0]).all()


@examples(20)
@given(*[st.integers(-4, 4) | st.none() | st.floats()] * 2)
def test_pairs_of_a_collection(i, j):
    assert len(TRIO) == 3
    try:
        f = TRIO.pair(i, j)
    except NsmError:
        assert i not in range(3) or j not in range(3)
        return
    assert f.source is NEURAL[int(i)] and f.target is NEURAL[int(j)]


@examples(3)
@given(st.integers(0, 10**6))
def test_repaired_maps_are_certified(seed):
    """A few inner vertices are moved at random."""
    random = np.random.default_rng(seed)
    s = NEURAL[0].surface
    inner = np.flatnonzero(np.linalg.norm(s.uv, axis=1) < 0.99)
    moved = random.choice(inner, 2, replace=False)
    image = PAIR.image_uv.copy()
    image[moved] += random.normal(scale=0.3, size=(2, 2))
    from nsm.results.certificate import Correction

    correction = Correction.between(PAIR.image_uv, image, Correction())
    for broken in (
        SurfaceMap(PAIR.source, PAIR.target, PAIR.map, PAIR.landmarks, correction=correction),
        Parameterization(NEURAL[0], planar(), correction=correction),
        SurfaceCollection(NEURAL, TRIO.maps, TRIO.landmarks, corrections={(0, 1): correction}),
    ):
        better = broken.repaired()
        assert better.certificate["certified"]
        assert better.certificate["flipped_triangles"] == 0


# ------------------------------------------------------------------ save and load

FIGURES = st.dictionaries(st.text(max_size=5), st.floats(allow_nan=False, allow_infinity=False))
SETTINGS = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**60), 2**60) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=5,
)


def same_map(a: torch.nn.Module, b: torch.nn.Module) -> None:
    left, right = a.state_dict(), b.state_dict()
    assert left.keys() == right.keys()
    assert all(torch.equal(left[key], right[key]) for key in left)


def same_surface(a: NeuralSurface, b: NeuralSurface) -> None:
    same_map(a.map, b.map)
    arrays = (
        "vertices",
        "faces",
        "uv",
        "source_vertex",
        "cut_vertex",
        "seam_pairs",
        "center",
        "scale",
    )
    for name in arrays:
        assert np.array_equal(getattr(a.surface, name), getattr(b.surface, name))
    assert (a.surface.name, a.surface.domain) == (b.surface.name, b.surface.domain)


@examples(5)
@given(FIGURES, st.dictionaries(st.text(max_size=5), SETTINGS, max_size=3), st.data())
def test_what_is_saved_is_what_is_loaded(tmp_path_factory, figures, config, data):
    folder = tmp_path_factory.mktemp("saved")
    network = NeuralMap(out_dim=3, **{**NETWORK, "depth": data.draw(st.integers(0, 2))})
    neural = NeuralSurface(NEURAL[0].surface, stirred(network), figures, config)
    flat = Parameterization(neural, FLAT.map, {"nsm": figures}, config)
    pair = SurfaceMap(neural, NEURAL[1], PAIR.map, PAIR.landmarks, figures, config)
    trio = SurfaceCollection([neural, *NEURAL[1:]], TRIO.maps, TRIO.landmarks, figures, config)
    for thing in (neural, flat, pair, trio):
        thing.save(folder)
        again = nsm.load(folder)
        assert type(again) is type(thing)
        assert (again.metrics, again.config) == (thing.metrics, thing.config)
        if thing is neural:
            same_surface(again, neural)
        elif thing is flat:
            same_surface(again.phi, neural)
            assert np.array_equal(again.uv, flat.uv)
            (folder / "map.json").unlink()
        elif thing is pair:
            same_surface(again.source, neural)
            same_surface(again.target, NEURAL[1])
            assert np.array_equal(again.image_uv, pair.image_uv)
            (folder / "pair.json").unlink()
        else:
            for a, b in zip(again.surfaces, trio.surfaces, strict=True):
                same_surface(a, b)
            for h, other in zip(again.maps, trio.maps, strict=True):
                same_map(h, other)


@examples(25)
@given(st.sampled_from([NEURAL[0], FLAT, PAIR, TRIO]), st.data())
def test_a_changed_byte_is_refused_or_harmless(tmp_path_factory, thing, data):
    folder = tmp_path_factory.mktemp("changed")
    thing.save(folder)
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    file = data.draw(st.sampled_from(files))
    content = bytearray(file.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    file.write_bytes(content)
    try:
        again = nsm.load(folder)
    except NsmError as error:
        assert "\n" not in str(error)
    else:
        assert type(again) is type(thing)


@examples(40)
@given(st.text(max_size=300))
def test_unknown_names_are_refused(text):
    for function in (nsm.load, Surface.load):
        with pytest.raises(NsmError) as caught:
            function(f"?{text}")
        assert cli_line(caught.value).count("\n") == 1


# ------------------------------------------------------------------ surfaces


@examples(40)
@given(vertices=ANY_ARRAY, faces=ANY_ARRAY)
def test_surfaces_of_any_arrays(vertices, faces):
    try:
        surface = Surface.from_arrays(vertices, faces)
    except NsmError:
        return
    assert surface.quality["flipped_triangles"] == 0


@examples(40)
@given(
    vertices=arrays.arrays(
        np.float64, (6, 3), elements=st.floats(-1e6, 1e6) | st.sampled_from([np.nan, np.inf, 0.0])
    ),
    faces=arrays.arrays(np.int64, (5, 3), elements=st.integers(-1, 6)),
)
def test_surfaces_of_any_few_triangles(vertices, faces):
    try:
        surface = Surface.from_arrays(vertices, faces)
    except NsmError:
        return
    assert surface.quality["flipped_triangles"] == 0
    assert np.isfinite(surface.uv).all()
    again = Surface.from_stored(surface.name, surface.domain, surface.to_stored())
    assert again.content_key() == surface.content_key()


@examples(30)
@given(
    st.lists(st.integers(-2, VERTICES + 1) | st.floats() | st.none(), max_size=4) | ANY_ARRAY,
    st.sampled_from(["disc", "square", "ball", ""]),
    st.sampled_from(["slim", "tutte", "none"]),
)
def test_seams_preimages_and_choices(numbers, domain, method):
    s = NEURAL[0].surface
    np.testing.assert_allclose(s.at(s.uv), s.vertices, atol=1e-9)
    try:
        assert s.preimages(numbers).shape == (len(numbers), 2)
        assert set(s.kept(numbers)) <= set(s.source_vertex)
    except NsmError as error:
        assert "\n" not in str(error)
    try:
        laid_out = Surface.from_arrays(
            s.vertices, s.faces, domain=domain, parameterization=method, seam_vertices=numbers
        )
    except NsmError as error:
        assert "\n" not in str(error)
    else:
        assert str(laid_out.domain) == domain and laid_out.quality["flipped_triangles"] == 0


@examples(30)
@given(st.text(max_size=20))
def test_only_names_of_the_catalogue_are_meshes_of_it(text):
    from nsm.surfaces.catalogue import catalogue_mesh

    assert all("/" not in name and line for name, line in catalogue_names().items())
    if text not in catalogue_names():
        with pytest.raises(NsmError):
            catalogue_mesh(text)


# ------------------------------------------------------------------ trainings


class Started(Exception):
    """A training began."""


@pytest.fixture
def untrained(monkeypatch):
    def begin(*_, **__):
        raise Started

    composed = {}

    def compose(overrides, settings):
        key = repr((overrides, settings))
        if key not in composed:
            composed[key] = compose_config(overrides, settings)
        return copy.deepcopy(composed[key])

    monkeypatch.setattr(api, "compose_config", compose)
    monkeypatch.setattr(pl.Trainer, "fit", begin)


VERTEX = st.integers(-2, VERTICES + 1)
POINT = st.tuples(*[st.floats(-2, 2) | st.just(math.nan)] * 3).map(list)
LANDMARKS = st.one_of(
    st.none(),
    st.text(max_size=3),
    st.integers(),
    ANY_ARRAY,
    st.lists(st.tuples(VERTEX, VERTEX), max_size=4),
    st.lists(st.tuples(VERTEX, VERTEX), max_size=4).map(np.array),
    st.lists(st.lists(VERTEX | POINT | st.none(), max_size=3), max_size=3),
    st.dictionaries(st.sampled_from(["source", "target", "x"]), st.lists(VERTEX, max_size=3)),
)
SHAPES = st.sampled_from([NEURAL[0], NEURAL[1], None, 3, "none.obj", {"name": "paraboloid"}, {}])


def begins(function: Callable, *given_: object, **options: object) -> bool:
    """Whether a training began; NsmError, in one line, is the only other end."""
    try:
        function(*given_, progress=False, **options)
    except NsmError as error:
        assert cli_line(error).count("\n") == 1
        return False
    except Started:
        return True
    raise AssertionError("it ended without a training")


@examples(15)
@given(SHAPES, SHAPES, LANDMARKS)
def test_what_map_pair_is_given(untrained, source, target, landmarks):
    begins(nsm.map_pair, source, target, landmarks)


@examples(10)
@given(st.lists(SHAPES, max_size=4) | st.just(NEURAL) | SHAPES, LANDMARKS)
def test_what_map_collection_is_given(untrained, surfaces, landmarks):
    begins(nsm.map_collection, surfaces, landmarks)


@examples(3)
@given(
    st.lists(
        st.tuples(*[st.integers(0, INNER - 1)] * 2),
        max_size=4,
        unique_by=(lambda p: p[0], lambda p: p[1]),
    ),
    st.data(),
)
def test_good_landmarks_are_accepted_and_bad_ones_refused_first(untrained, pairs, data):
    ends = NEURAL[0], NEURAL[1]
    assert begins(nsm.map_pair, *ends, pairs)
    bad = [(0, VERTICES), (-2, 0), (0, math.nan), (0, [0, 0, math.inf])]
    assert not begins(nsm.map_pair, *ends, [*pairs, data.draw(st.sampled_from(bad))])
    if pairs:
        assert begins(nsm.map_pair, *ends, [*pairs, (-1, 0)])  # one that the source lacks
        twice = (pairs[0][0], next(v for v in range(9) if v not in [q for _, q in pairs]))
        assert not begins(nsm.map_pair, *ends, [*pairs, twice])
        uneven = {"source": [p for p, _ in pairs], "target": [q for _, q in pairs][:-1]}
        assert not begins(nsm.map_pair, *ends, uneven)


@examples(5)
@given(
    st.sampled_from([NEURAL[0].surface, NEURAL[0], None, 3, "terrain"]),
    st.lists(st.text(max_size=8) | st.sampled_from(["seed=1", "seed=x", "energy=a"]), max_size=2),
)
@example(thing=None, overrides=[])
def test_what_overfit_and_parameterize_are_given(untrained, thing, overrides):
    good = all(word == "seed=1" for word in overrides)
    for function, kinds in (
        (nsm.overfit, (Surface, str)),
        (nsm.parameterize, (NeuralSurface, Surface, str)),
    ):
        started = begins(function, thing, overrides=overrides)
        assert not started or isinstance(thing, kinds)
        assert started or not (good and isinstance(thing, kinds))


def test_an_impossible_folder_is_refused(untrained, tmp_path):
    (tmp_path / "file").write_text("")
    assert not begins(nsm.overfit, NEURAL[0].surface, folder=tmp_path / "file" / "run")


# ------------------------------------------------------------------ errors and extensions


def cli_line(error: NsmError) -> str:
    """What the command prints of it."""
    import contextlib
    import io

    with contextlib.redirect_stderr(io.StringIO()) as printed:
        cli._say(str(error))
    return printed.getvalue()


@examples(50)
@given(st.text())
def test_errors_are_one_line(text):
    line = cli_line(NsmError(text))
    assert line.count("\n") == 1 and line[:-1].isprintable()


@pytest.fixture
def tables():
    """The registries, put back as they were."""
    tables = [ANALYTIC, BLOCKS, extensions._KINDS, vars(extensions.registered)]
    tables += [ConfigStore.instance().repo.setdefault(group, {}) for group in GROUPS]
    before = [dict(table) for table in tables]
    yield
    for table, old in zip(tables, before, strict=True):
        table.clear()
        table.update(old)


class Doubled(torch.nn.Module):
    def __init__(self, factor: float = 2.0) -> None:
        super().__init__()
        self.out_dim, self.factor = 2, factor

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.factor * x


NAMES = st.text(max_size=6) | st.from_regex(r"[a-z][a-z0-9_]{0,5}", fullmatch=True)
KINDS = {
    "energy": (nsm.register_energy, lambda m: m.trace),
    "activation": (nsm.register_activation, lambda z, a=1.0: a * z),
    "encoding": (nsm.register_encoding, Doubled),
    "block": (nsm.register_block, lambda width, act: torch.nn.Linear(width, width)),
    "analytic surface": (nsm.register_analytic, lambda u, v: (u, v, u * v)),
}
GROUPS = ("energy", "activation", "encoding")


@examples(40)
@given(NAMES | st.sampled_from(["arap", "softplus", "siren", "identity", "plain", "sphere_cap"]))
def test_names_of_extensions(tables, name):
    for register, thing in KINDS.values():
        try:
            register(name, thing)
        except NsmError as error:
            assert error.kind in ("invalid_name", "name_taken")
            assert (error.kind == "name_taken") == bool(extensions._NAME.fullmatch(name))
        else:
            assert extensions._NAME.fullmatch(name)


@examples(3)
@given(st.lists(st.floats(0.7, 1.3), min_size=12, max_size=12), st.floats(0.1, 10))
def test_closed_surfaces_of_any_radii(radii, scale):
    """An icosahedron with any radii is laid out injectively on the orbifold, and stays whole."""
    mesh = trimesh.creation.icosahedron()
    vertices, faces = scale * np.array(radii)[:, None] * mesh.vertices, np.asarray(mesh.faces)
    surface = Surface.from_arrays(vertices, faces, domain="orbifold")
    first, whole = surface.whole()
    assert np.array_equal(whole, faces)
    assert all(np.array_equal(*pair) for pair in zip(surface.shown(), (first, whole), strict=True))
    own, corners = surface.file_faces()
    assert np.array_equal(own, faces) and np.array_equal(surface.source_vertex[corners], faces)
    kept = NeuralSurface(surface, NEURAL[0].map).file_mesh()
    assert np.array_equal(kept[0], vertices) and np.array_equal(kept[1], faces)
    assert np.allclose(surface.vertices[first] / surface.scale + surface.center, vertices)
    assert (signed_areas(surface.uv, surface.faces) > 0).all()
    assert math.isclose(signed_areas(surface.uv, surface.faces).sum(), 2.0, rel_tol=1e-9)
    again = Surface.from_stored(surface.name, "orbifold", surface.to_stored())
    for name, array in surface.arrays().items():
        assert np.array_equal(again.arrays()[name], array)


@examples(3)
@given(*[st.floats(0.01, 10)] * 3)
def test_what_is_registered_is_what_is_used(tables, a, b, c):
    def target(name: str) -> str:
        return f"nsm.extensions.registered.{name}"

    nsm.register_energy("bent", lambda m: a * m.trace + b / (m.determinant + c))
    source = torch.eye(2, dtype=torch.float64).expand(4, 2, 2)
    image = torch.diag_embed(torch.tensor([[1.0, 1], [4, 1], [4, 9], [0, 1]]).double())
    t, d = torch.tensor([2.0, 5, 13, 1]).double(), torch.tensor([1.0, 4, 36, 0]).double()
    bent = made({"_target_": target("bent")})
    assert torch.allclose(bent(source, image), a * t + b / (d + c), rtol=1e-6)
    nsm.register_activation("sloped", lambda z, slope=1.0: slope * z)
    z = torch.tensor([-a, b], dtype=torch.float64)
    sloped = as_activation(made({"_target_": target("sloped"), "slope": c}))
    assert torch.allclose(sloped(z), c * z)
    nsm.register_encoding("doubled", Doubled)
    nsm.register_block("linear", lambda width, activation: torch.nn.Linear(width, width))
    doubled = made({"_target_": target("doubled"), "factor": a})
    settings = {**NETWORK, "block": "linear", "activation": sloped, "encoding": doubled}
    network = NeuralMap(out_dim=3, **settings).double()
    x = torch.tensor([[0.1, 0.2], [b / 10, c / 10]], dtype=torch.float64)
    expected = torch.func.vmap(torch.func.jacrev(lambda p: network(p[None])[0]))(x)
    assert torch.allclose(network.value_and_jacobian(x)[1], expected)
    nsm.register_analytic("twisted", lambda u, v, height=1.0: (u, v, height * u * v))
    surface = build_analytic({"name": "twisted", "height": c}).double()
    p = surface(x) / surface(x)[:, :1] * x[:, :1]  # it is scaled to the area of the disc
    assert torch.allclose(p, torch.stack([x[:, 0], x[:, 1], c * x[:, 0] * x[:, 1]], dim=1))


# ------------------------------------------------------------------ nothing is left out

PROPERTIES: dict[str, list[Callable]] = {
    "NeuralSurface.__call__": [test_functions_of_the_domain, test_functions_of_tensors],
    "NeuralSurface.jacobian": [test_functions_of_the_domain, test_jacobians_are_differences],
    "NeuralSurface.file_mesh": [test_closed_surfaces_of_any_radii],
    "NeuralSurface.module": [test_modules_give_what_their_maps_give],
    "NeuralSurface.spectrum": [test_spectra],
    "NeuralSurface.to": [test_functions_of_tensors],
    "NeuralSurface.value_and_jacobian": [
        test_functions_of_the_domain,
        test_modules_give_what_their_maps_give,
    ],
    "NeuralSurface.in_original_units": [
        test_functions_of_space,
        test_points_keep_to_the_target_and_units_come_back,
    ],
    "NeuralSurface.to_mesh": [test_what_is_saved_is_what_is_loaded],
    "NeuralSurface.save": [test_what_is_saved_is_what_is_loaded],
    "NsmError": [test_errors_are_one_line],
    "Parameterization.__call__": [test_functions_of_the_domain],
    "Parameterization.module": [test_modules_give_what_their_maps_give],
    "Parameterization.repaired": [test_repaired_maps_are_certified],
    "Parameterization.save": [test_what_is_saved_is_what_is_loaded],
    "Surface.arrays": [test_closed_surfaces_of_any_radii],
    "Surface.from_closed": [test_closed_surfaces_of_any_radii],
    "Surface.file_faces": [test_closed_surfaces_of_any_radii],
    "Surface.shown": [test_closed_surfaces_of_any_radii],
    "Surface.whole": [test_closed_surfaces_of_any_radii],
    "Surface.from_arrays": [test_surfaces_of_any_arrays, test_surfaces_of_any_few_triangles],
    "Surface.from_cut": [test_surfaces_of_any_few_triangles],
    "Surface.from_stored": [test_surfaces_of_any_few_triangles],
    "Surface.to_stored": [test_surfaces_of_any_few_triangles],
    "Surface.at": [test_seams_preimages_and_choices],
    "Surface.content_key": [test_surfaces_of_any_few_triangles],
    "Surface.kept": [test_seams_preimages_and_choices],
    "Surface.load": [test_unknown_names_are_refused],
    "Surface.preimages": [test_seams_preimages_and_choices],
    "SurfaceCollection.__len__": [test_pairs_of_a_collection],
    "SurfaceCollection.pair": [test_pairs_of_a_collection],
    "SurfaceCollection.repaired": [test_repaired_maps_are_certified],
    "SurfaceCollection.save": [test_what_is_saved_is_what_is_loaded],
    "SurfaceMap.__call__": [test_functions_of_space],
    "SurfaceMap.planar": [
        test_functions_of_the_domain,
        test_points_keep_to_the_target_and_units_come_back,
    ],
    "SurfaceMap.bake": [test_what_is_baked],
    "SurfaceMap.places": [test_places_are_those_of_points],
    "SurfaceMap.transfer": [test_transfer],
    "SurfaceMap.matrix": [test_the_matrix_transfers],
    "SurfaceMap.inverse": [test_functions_of_space],
    "SurfaceMap.correspondences": [test_correspondences_and_morphs_are_on_the_files],
    "SurfaceMap.export_morph": [test_correspondences_and_morphs_are_on_the_files],
    "SurfaceMap.module": [test_functions_of_tensors, test_modules_give_what_their_maps_give],
    "SurfaceMap.to": [test_functions_of_tensors, test_modules_give_what_their_maps_give],
    "SurfaceMap.value_and_jacobian": [test_functions_of_space],
    "SurfaceMap.morph": [test_morph],
    "SurfaceMap.aligned": [test_functions_of_space],
    "SurfaceMap.repaired": [test_repaired_maps_are_certified],
    "SurfaceMap.save": [test_what_is_saved_is_what_is_loaded],
    "catalogue_names": [test_only_names_of_the_catalogue_are_meshes_of_it],
    "load": [test_what_is_saved_is_what_is_loaded, test_a_changed_byte_is_refused_or_harmless],
    "map_collection": [test_what_map_collection_is_given],
    "map_pair": [
        test_what_map_pair_is_given,
        test_good_landmarks_are_accepted_and_bad_ones_refused_first,
    ],
    "overfit": [test_what_overfit_and_parameterize_are_given],
    "parameterize": [test_what_overfit_and_parameterize_are_given],
    **{
        f"register_{kind.split()[0]}": [
            test_names_of_extensions,
            test_what_is_registered_is_what_is_used,
        ]
        for kind in KINDS
    },
}


def public() -> list[str]:
    """Every public function, and every public method of public classes."""
    names = []
    for name in nsm.__all__:
        thing = getattr(nsm, name)
        if not inspect.isclass(thing) or issubclass(thing, Exception):
            names.append(name)
            continue
        for attribute, value in vars(thing).items():
            own = inspect.isfunction(value) or isinstance(value, classmethod)
            called = attribute in ("__call__", "__len__")
            if own and (called or not attribute.startswith("_")):
                names.append(f"{name}.{attribute}")
    return names


def test_everything_public_has_a_property():
    assert sorted(PROPERTIES) == sorted(public())
    for tests in PROPERTIES.values():
        assert tests
        for test in tests:
            assert getattr(test, "is_hypothesis_test", False)
            assert Path(inspect.getfile(test)) == Path(__file__)
