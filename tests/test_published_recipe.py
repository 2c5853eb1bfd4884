"""The benchmark of the published recipe trains what it says, where it says."""

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny import dome

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
import published  # noqa: E402
import training  # noqa: E402

FULL = published.FORMS["full"]
# the recipe but for sizes
SMALL = dataclasses.replace(
    FULL,
    surface=("map.width=8", "map.depth=2", "sampler.pool=500", "trainer.max_steps=2"),
    pair=("trainer.max_steps=2",),
    early=(0.0, 0.0),
)


def test_the_full_form_changes_nothing_of_the_paper():
    assert (FULL.surface, FULL.pair) == ((), ())


def test_the_full_form_is_trained_on_the_gpu_where_there_is_one(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert (FULL.accelerator, published.FORMS["reduced"].accelerator) == ("gpu", "cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert FULL.accelerator == "cpu"


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """What two steps of the surfaces and of the map leave, and the hardware of each training."""
    folder, places = tmp_path_factory.mktemp("published"), []
    file = folder / "found.json"

    def train(*given, **words):
        places.append(words["accelerator"])
        return training.train(*given, **words)

    surfaces = [dome(0.3, 5), dome(0.6, 5)]
    pair = " → ".join(surface.name for surface in surfaces)
    ready = [f"{surface.name}/default" for surface in surfaces] + [f"{pair}/default"]
    file.write_text(json.dumps({key: {"seconds": 0, "steps": 0, "metrics": {}} for key in ready}))
    store = published.Store(file, SMALL)
    none = [np.zeros(0, dtype=np.int64)] * 2
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(published, "train", train)
        phis = [published.overfitted(store, s, SMALL, folder / "kept") for s in surfaces]
        published.mapped(store, phis, none, [], SMALL)
    return json.loads(file.read_text()), pair, places, published.tables(file)


def test_each_training_is_measured_on_its_way_and_at_its_stop(found):
    entries, pair, places, _ = found
    assert places == [SMALL.accelerator] * 3
    for subject in ("dome 0.3", "dome 0.6", pair):
        stop = entries[f"{subject}/published"]
        assert (stop["steps"], stop["stopped_by"]) == (2, "max_steps")
        assert stop["gradient_norm_of_the_sum"] > 0
        assert entries[f"{subject}/published, on the way"]["steps"] == 1


def test_the_table_has_the_map_as_it_starts_and_flips(found):
    entries, pair, _, table = found
    assert {"flipped_percent", "flipped_before_repair_percent"} <= entries[f"{pair}/before"][
        "metrics"
    ].keys()
    assert f"| {pair}, before | 0 | 0 |" in table
