"""Trainings that two processes share: the same result as one, and one set of files."""

import json
import os
import subprocess
import sys

import pytest
import torch
from torch.multiprocessing.spawn import ProcessRaisedException

from nsm.data.shard import Shard
from nsm.errors import NsmError
from nsm.pipeline.processes import raised_by

# a process of its own: forking one that has run threads is not safe
SCRIPT = """
import json, sys
from pathlib import Path
import nsm
from nsm.surfaces.shapes import hemisphere

folder = Path(sys.argv[1])
short = ["trainer.max_steps=12", "data.steps_per_epoch=6", "data.held_out=256", "map.width=16",
         "optimizer=sgd", "optimizer.lr=0.02", "artefacts=false", "logger=csv",
         "trainer.log_every=3"]
surface = nsm.Surface.from_arrays(*hemisphere(8), parameterization="tutte", cache=False)
phis = [
    nsm.overfit(surface, folder=folder / f"overfit_{n}", progress=False,
                overrides=[*short, "data.batch_size=128", f"trainer.devices={n}"])
    for n in (1, 2)
]
words = [*short, "data.batch_size=96", "certification.repair=false", "optimizer.lr=0.0005"]
for n in (1, 2):
    nsm.map_pair(phis[0], phis[1], [(7, 7), (100, 100), (180, 180)],
                 folder=folder / f"pair_{n}", progress=False,
                 overrides=[*words, "constraints.boundary=penalty", f"trainer.devices={n}"])
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked")
def test_two_processes_give_the_result_of_one(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(tmp_path)],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        timeout=1200,
    )
    assert done.returncode == 0, done.stderr
    for task in ("overfit", "pair"):
        one, two = (
            torch.load(tmp_path / f"{task}_{n}" / "last.ckpt", weights_only=True) for n in (1, 2)
        )
        assert one["global_step"] == two["global_step"] == 12
        assert one["state_dict"].keys() == two["state_dict"].keys()
        for name, value in one["state_dict"].items():
            torch.testing.assert_close(two["state_dict"][name], value, rtol=1e-4, atol=1e-6)
        tables = [
            (tmp_path / f"{task}_{n}" / "csv" / "metrics.csv").read_text().splitlines()
            for n in (1, 2)
        ]
        assert len(tables[0]) == len(tables[1]) > 4
        for n in (1, 2):
            words = json.loads((tmp_path / f"{task}_{n}" / "metrics.json").read_text())
            assert words["steps"] == 12
        files = [sorted(p.name for p in (tmp_path / f"{task}_{n}").iterdir()) for n in (1, 2)]
        assert files[0] == files[1]


def test_parts_are_equal_and_apart():
    rows = torch.arange(11)
    parts = [Shard(rank, 3).of_rows(rows) for rank in range(3)]
    assert [len(part) for part in parts] == [3, 3, 3]
    assert sorted(torch.cat(parts).tolist()) == list(range(9))
    assert torch.equal(Shard().of_rows(rows), rows)


def test_bad_input_in_a_process_is_raised_as_such():
    text = "\n\n-- Process 1 terminated with the following error:\nTraceback ...\n{}\n"
    bad = ProcessRaisedException(text.format("nsm.errors.NsmError: mesh: no; do so"), 1, 123)
    assert isinstance(raised_by(bad), NsmError)
    assert str(raised_by(bad)) == "mesh: no; do so"
    defect = ProcessRaisedException(text.format("ValueError: nsm.errors.NsmError: no"), 1, 123)
    assert raised_by(defect) is defect
