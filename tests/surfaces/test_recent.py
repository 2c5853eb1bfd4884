"""Meshes that were just read or cleaned are not read or cleaned again."""

import numpy as np
import pytest
import trimesh
from domains.orbifold.shapes import limbs
from rich.console import Console

from nsm.config import compose_config
from nsm.errors import NsmError
from nsm.pipeline import make_task, resolve_inputs
from nsm.pipeline.task import Given
from nsm.surfaces import loading, validation
from nsm.surfaces.loading import load_mesh
from nsm.surfaces.recent import Recent, content
from nsm.surfaces.validation import Repairs, clean


@pytest.fixture
def counted(monkeypatch):
    """How many meshes were really read and cleaned: {"read": 0, "cleaned": 0}."""
    count = {"read": 0, "cleaned": 0}

    def counting(name, function):
        def call(*arguments):
            count[name] += 1
            return function(*arguments)

        return call

    monkeypatch.setattr(loading, "_READ", Recent())
    monkeypatch.setattr(validation, "_CLEANED", Recent())
    monkeypatch.setattr(loading, "_read", counting("read", loading._read))
    monkeypatch.setattr(validation, "_cleaned", counting("cleaned", validation._cleaned))
    return count


def test_a_file_is_read_again_only_if_its_content_changed(tmp_path, counted):
    file = tmp_path / "box.off"
    trimesh.creation.box().export(file)
    first, again = load_mesh(file), load_mesh(file)
    assert counted["read"] == 1
    for a, b in zip(first[:2], again[:2], strict=True):
        assert np.array_equal(a, b) and not np.shares_memory(a, b)
    again[0][:] = 7  # what a caller does with its arrays concerns nobody else
    assert np.array_equal(load_mesh(file)[0], first[0])
    file.write_text(file.read_text().replace("0.5", "0.6"))
    assert load_mesh(file)[0].max() == 0.6 and counted["read"] == 2
    file.write_text("OFF\nnonsense")
    for _ in range(2):
        with pytest.raises(NsmError):
            load_mesh(file)
    file.unlink()
    with pytest.raises(NsmError) as caught:
        load_mesh(file)
    assert caught.value.kind == "missing_file"


def test_a_mesh_is_cleaned_again_only_for_other_arrays_or_decisions(counted):
    box = trimesh.creation.box()
    first = clean(box.vertices, box.faces, "box")
    again = clean(box.vertices.copy(), box.faces.astype(np.int32), "box")
    assert counted["cleaned"] == 1 and again.log == first.log
    assert np.array_equal(again.faces, first.faces)
    again.faces[:] = 0
    assert np.array_equal(clean(box.vertices, box.faces, "box").faces, first.faces)
    open_ = box.faces[1:]
    clean(box.vertices, open_, "box")
    assert len(clean(box.vertices, open_, "box", Repairs(fill_holes=4)).faces) > len(open_)
    clean(2 * box.vertices, box.faces, "box")
    assert counted["cleaned"] == 4


def test_the_oldest_are_forgotten_first_and_large_ones_are_never_kept():
    recent, made = Recent(most_bytes=80), []

    def get(key, size=4):
        return recent.get(key, lambda: made.append(key) or (np.zeros(size),))

    for key in ("a", "b", "a", "c", "a", "b"):  # b goes when c comes: two of 32 bytes fit
        get(key)
    assert made == ["a", "b", "c", "b"]
    get("large", 11), get("large", 11)
    assert made[4:] == ["large", "large"]
    get("a")
    assert len(made) == 6


def test_content_tells_types_and_shapes_apart():
    zeros = [np.zeros(4), np.zeros((2, 2)), np.zeros(4, np.int64), np.zeros(8, np.float32)]
    assert len({content(array) for array in zeros}) == 4
    assert content(np.zeros((2, 2)).T) == content(np.zeros((2, 2)))


class Reached(Exception):
    pass


def test_a_pair_from_files_is_read_and_cleaned_once(counted, tmp_path, monkeypatch):
    """Though domain=auto, the parts to close and the preparation all ask for the meshes."""
    points, faces, tips = limbs()
    files = [tmp_path / f"{name}.obj" for name in ("first", "second")]
    for file, stretch in zip(files, (1.0, 1.2), strict=True):
        trimesh.Trimesh(points * [stretch, 1, 1], faces, process=False).export(file)
    pairs = [[int(v)] * 2 for v in [*tips, points[:, 2].argmax()]]
    words = ["task=pair_map", f"source={files[0]}", f"target={files[1]}", "surface.cache=false"]
    task = make_task(compose_config(words), Console(quiet=True))

    def reached(surfaces, *_):
        assert [len(surface.whole()[0]) for surface in surfaces] == [len(points)] * 2
        raise Reached

    monkeypatch.setattr(resolve_inputs, "cached_surfaces", reached)
    given = Given(landmarks=pairs)
    task.choose_domain(given)
    with pytest.raises(Reached):
        task.prepare(given)
    assert task.domain.name == "orbifold"
    assert counted == {"read": 2, "cleaned": 2}
