"""Trainings that go wrong: numbers that are not finite, kills, full disks, memory that is short."""

import errno
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import cache
from itertools import permutations

import pytest
import torch
from domains.orbifold.shapes import torus
from interruption import interrupted
from tiny import results

import nsm
from nsm.config import compose_config
from nsm.domains import Disc, Surface
from nsm.errors import NsmError
from nsm.maps import build_network
from nsm.pipeline import Given, run_task
from nsm.pipeline.folder_lock import folder_lock
from nsm.results import NeuralSurface
from nsm.results.analytic import analytic_surface
from nsm.results.files import read_pair, write_pair
from nsm.surfaces.shapes import ring_mesh
from nsm.tasks import Overfit, microbatching

WORDS = ["experiment=quick", "data.steps_per_epoch=10", "data.held_out=64", "data.batch_size=64"]
WORDS += ["encoding.resolutions=[8]", "trainer.threads=1", "logger=none", "artefacts=false"]
WORDS += ["trainer.progress=false", "trainer.max_steps=60"]


@pytest.fixture(scope="module")
def surface():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Disc, "mesh", lambda self, rings=6: ring_mesh(6))
        plain = analytic_surface({"name": "paraboloid"}, Disc()).surface
    return replace(plain, quality={"median_symmetric_dirichlet": 4.0})


def run(surface, folder, *words, resuming=False):
    config = compose_config(["task=overfit", *WORDS, *words])
    return run_task(config, folder, Given(surface=surface), resuming=resuming)


def weights(folder):
    return nsm.load(folder).map.state_dict()


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


def told(folder):
    return json.loads((folder / "metrics.json").read_text())["faults"]


# --- numbers that are not finite ---------------------------------------------------------------


def spoil(monkeypatch, when, how):
    """Let the loss, or its gradient, be what ``how`` makes of it at the steps ``when``."""
    whole = Overfit.training_step

    def step(self, batch, index):
        loss = whole(self, batch, index)
        return how(loss, self) if when(self.global_step) else loss

    monkeypatch.setattr(Overfit, "training_step", step)


FAULTS = {
    "loss is NaN": lambda loss, module: loss * float("nan"),
    "loss is infinite": lambda loss, module: loss + float("inf"),
    # finite itself: the root's slope at zero is not
    "gradient is not finite": lambda loss, module: loss + (module.map.output.bias.sum() * 0).sqrt(),
}


@pytest.mark.parametrize("how", FAULTS.values(), ids=FAULTS.keys())
def test_a_step_that_is_not_finite_is_taken_back(surface, tmp_path, monkeypatch, how):
    spoil(monkeypatch, lambda step: step == 33, how)
    neural = run(surface, tmp_path, "scheduler=constant")
    assert told(tmp_path)["rollbacks"] == [{"step": 33, "back_to": 0}]
    assert all(torch.isfinite(v).all() for v in weights(tmp_path).values())
    assert neural.metrics["rms_percent"] < 20
    rates = torch.load(tmp_path / "last.ckpt", weights_only=True)["optimizer_states"][0]
    config = compose_config(["task=overfit", *WORDS])
    usual = config.scheduler.peak * config.optimizer.lr
    assert rates["param_groups"][0]["lr"] == pytest.approx(usual / 2)


def test_the_state_goes_back_to_the_one_that_was_kept(surface, tmp_path, monkeypatch):
    states = {}

    def note(self, batch, index):
        states[self.global_step] = {k: v.clone() for k, v in self.map.state_dict().items()}

    monkeypatch.setattr(Overfit, "on_train_batch_start", note)
    spoil(monkeypatch, lambda step: step == 53, FAULTS["loss is NaN"])
    run(surface, tmp_path)
    assert told(tmp_path)["rollbacks"] == [{"step": 53, "back_to": 50}]
    assert same(states[54], states[50]) and not same(states[53], states[50])


def test_it_gives_up_with_one_line_after_a_few_tries(surface, tmp_path, monkeypatch):
    spoil(monkeypatch, lambda step: step >= 20, FAULTS["loss is NaN"])
    with pytest.raises(NsmError) as error:
        run(surface, tmp_path)
    assert (error.value.kind, error.value.key) == ("not_finite", "optimizer.lr")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "metrics.json").exists()


def test_a_first_step_that_is_not_finite_has_nothing_to_go_back_to(surface, tmp_path, monkeypatch):
    spoil(monkeypatch, lambda step: True, FAULTS["loss is NaN"])
    with pytest.raises(NsmError) as error:
        run(surface, tmp_path)
    assert (error.value.kind, error.value.key) == ("not_finite", None)


def test_a_last_step_that_is_not_finite_is_not_in_the_checkpoint(surface, tmp_path, monkeypatch):
    def spoilt(self, *_):
        if self.global_step == 60:
            torch.nn.init.constant_(self.map.output.weight, float("nan"))

    monkeypatch.setattr(Overfit, "on_train_batch_end", spoilt)
    run(surface, tmp_path)
    before, faults = weights(tmp_path), told(tmp_path)
    assert faults["rollbacks"] == [{"step": 60, "back_to": 50}]
    (tmp_path / "metrics.json").unlink()
    run(surface, tmp_path, resuming=True)
    assert same(weights(tmp_path), before) and told(tmp_path) == faults


def test_a_rolled_back_training_resumes_to_the_same_weights(surface, tmp_path, monkeypatch):
    spoil(monkeypatch, lambda step: step in (25, 41), FAULTS["loss is NaN"])
    run(surface, tmp_path / "whole")
    cut(surface, tmp_path / "cut", at=30)
    run(surface, tmp_path / "cut", resuming=True)
    assert told(tmp_path / "cut") == told(tmp_path / "whole")
    assert same(weights(tmp_path / "whole"), weights(tmp_path / "cut"))


def cut(surface, folder, at):
    """Stop right after the checkpoint of a step."""
    with interrupted(at):
        run(surface, folder)


# --- kill -9 -----------------------------------------------------------------------------------


def forked(work):
    """Do it in a process of its own, whose number is given back."""
    child = os.fork()
    if child:
        return child
    try:
        with open(os.devnull, "w") as nothing:
            os.dup2(nothing.fileno(), 1)
            os.dup2(nothing.fileno(), 2)
            work()
        os._exit(0)
    except BaseException:
        os._exit(1)


def died(child):
    status = os.waitpid(child, 0)[1]
    return os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL


def killed_at(call, name):
    """Replace a function of ``os`` by one that, at its n-th call, kills the process instead."""
    real, seen = getattr(os, name), [0]

    def deadly(*args, **extra):
        seen[0] += 1
        if seen[0] == call:
            os.kill(os.getpid(), signal.SIGKILL)
        return real(*args, **extra)

    setattr(os, name, deadly)


@pytest.fixture(scope="module")
def whole(surface, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    run(surface, folder)
    return weights(folder)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_killed_again_and_again_at_random_it_ends_at_the_same_weights(surface, tmp_path, whole):
    folder, chance = tmp_path / "killed", random.Random(0)
    kills = 0
    for _ in range(40):
        child = forked(lambda: run(surface, folder, resuming=folder.exists()))
        deadline = time.monotonic() + chance.uniform(0.02, 0.5)
        while time.monotonic() < deadline and not (folder / "metrics.json").exists():
            time.sleep(0.005)
        os.kill(child, signal.SIGKILL)
        kills += died(child)
        if (folder / "metrics.json").exists() or kills >= 6:
            break
    assert kills >= 1
    run(surface, folder, resuming=True)
    assert same(weights(folder), whole)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize(("name", "call"), [("fsync", 3), ("replace", 2), ("fsync", 6)])
def test_killed_while_saving_it_ends_at_the_same_weights(surface, tmp_path, whole, name, call):
    """Before the bytes are on the disk, before the renaming, before that is on the disk."""
    folder = tmp_path / "killed"

    def work():
        killed_at(call, name)
        run(surface, folder)

    assert died(forked(work))
    run(surface, folder, resuming=True)
    assert same(weights(folder), whole)
    assert not list(folder.glob("*.tmp"))


MAP_WORDS = ["data.batch_size=64", "data.held_out=64", "data.steps_per_epoch=4", "logger=none"]
MAP_WORDS += ["trainer.max_steps=20", "trainer.threads=1", "trainer.progress=false"]
MAP_WORDS += ["artefacts=false"]
NETWORK = ["map.width=8", "map.depth=1"]
SPLINES = {
    # ends in quasi-Newton steps
    "pair_map": ["map.cells=8", "constraints.triangles_from=0.8", "optimizer.iterations=4"],
    "collection_map": ["map.cells=8", "constraints.triangles_from=0.9", "optimizer.iterations=6"],
    # has no others, and may end before its last step
    "param": ["map.cells=8", "optimizer.levels=[8]", "optimizer.steps=[]"],
}
SPLINES["param"] += ["optimizer.iterations=2"]


def mapped(task, folder, resuming=False):
    """What a map's training ends at: the weights, and where the vertices go."""
    phi, psi, _ = neural = tiny_surfaces()
    if task == "closed":
        phi, psi = tiny_rings()
        config = compose_config(
            ["task=pair_map", "experiment=adam", *MAP_WORDS, *NETWORK, "encoding.resolutions=[8]"]
        )
    else:
        config = compose_config([f"task={task}", *MAP_WORDS, *SPLINES.get(task, NETWORK)])
    if task == "param":
        result = run_task(config, folder, Given(phi=phi), resuming=resuming)
        return {**result.map.state_dict(), "uv": torch.from_numpy(result.uv)}
    if task == "collection_map":
        marks = [[0, 9], [0, 8], [0, 9]]
        given = Given(surfaces=neural, landmarks=marks)
        trio = run_task(config, folder, given, resuming=resuming)
        found = {(i, key): w for i, h in enumerate(trio.maps) for key, w in h.state_dict().items()}
        images = {(i, j): trio.pair(i, j).image_uv for i, j in permutations(range(3), 2)}
        return found | {ends: torch.from_numpy(uv) for ends, uv in images.items()}
    given = Given(source=phi, target=psi, landmarks=[(0, 0), (9, 8)])
    result = run_task(config, folder, given, resuming=resuming)
    return {**result.map.state_dict(), "uv": torch.from_numpy(result.image_uv)}


@cache
def tiny_surfaces():
    return results(rings=3).neural


@cache
def tiny_rings():
    """Two closed surfaces of genus 1."""
    points, faces = torus((12, 8))
    rings = []
    for height in (1.0, 1.3):
        s = Surface.from_arrays(points * [1, 1, height], faces, name="ring", domain="torus")
        encoding = {"_target_": "nsm.maps.SplineGrid", "resolutions": [16]}
        phi = build_network(
            map={"width": 4, "depth": 1}, encoding=s.domain.encoding(encoding, s.lattice)
        )
        rings.append(NeuralSurface(s, phi.eval().requires_grad_(False)))
    return rings


class Calls:
    """Counts the calls of Python functions from the first checkpoint that is written, and kills the
    process at the last of so many."""

    def __init__(self, last=None):
        self.count, self.last = 0, last

    def __enter__(self):
        from nsm.results import callbacks

        written = callbacks.AtomicCheckpoint.on_train_epoch_end

        def begin(*args):
            written(*args)
            sys.setprofile(self)

        self.patch = pytest.MonkeyPatch()
        self.patch.setattr(callbacks.AtomicCheckpoint, "on_train_epoch_end", begin)
        return self

    def __exit__(self, *_):
        sys.setprofile(None)
        self.patch.undo()

    def __call__(self, frame, event, argument):
        self.count += event == "call"
        if self.count == self.last:
            os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize("task", ["param", "pair_map", "closed", "collection_map"])
def test_a_map_killed_at_random_moments_ends_at_the_same_result(tmp_path, task):
    """Whatever it was doing: training, saving, certifying, writing its results."""
    mapped(task, tmp_path / "first")  # what is imported late is imported now
    with Calls() as calls:
        expected = mapped(task, tmp_path / "whole")
    chance, folder = random.Random(task), tmp_path / "killed"
    steps = []
    for share in (chance.uniform(0.1, 0.4), chance.uniform(0.02, 0.4)):

        def work(last=int(share * calls.count)):
            with Calls(last):
                mapped(task, folder, resuming=folder.exists())

        # calls are counted from a checkpoint on: none is written after the training's end
        assert died(forked(work)) or steps == [20]
        steps.append(torch.load(folder / "last.ckpt", weights_only=True)["global_step"])
    assert 0 < steps[0] <= steps[1] <= 20
    assert same(mapped(task, folder, resuming=True), expected)
    assert not list(folder.glob("*.tmp")) and (folder / "metrics.json").exists()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize("call", range(1, 6))
def test_an_artefact_written_over_another_is_the_one_or_the_other(tmp_path, call):
    """Killed at any renaming or removal on the way, and at the next writing as well."""
    stem = tmp_path / "surface"

    def write(value):
        write_pair(stem, "f", {"x": torch.full((3,), float(value))}, {"value": value})

    def read():
        tensors, words = read_pair(stem, "f")
        assert (tensors["x"] == words["value"]).all()
        return words["value"]

    write(1)
    for new in (2, 3):

        def work(new=new):
            killed_at(call, "replace")
            killed_at(call, "fsync")
            write(new)

        before = read()
        died(forked(work))
        assert read() in (before, new)
    write(4)
    assert read() == 4
    assert sorted(p.name for p in tmp_path.iterdir() if p.suffix != ".tmp") == [
        "surface.json",
        "surface.safetensors",
    ]


@pytest.mark.parametrize("part", ["state_dict", "optimizer_states", "loops", "callbacks"])
def test_a_checkpoint_of_another_make_is_refused(surface, few_steps, tmp_path, part):
    """As of a stranger, or of a network that has other layers."""
    shutil.copytree(few_steps, tmp_path, dirs_exist_ok=True)
    state = torch.load(tmp_path / "last.ckpt", weights_only=True)
    state[part] = {name: 3 for name in state[part]} if part == "callbacks" else {"x": 1}
    torch.save(state, tmp_path / "last.ckpt")
    with pytest.raises(NsmError) as error:
        run(surface, tmp_path, resuming=True)
    assert error.value.kind == "damaged_file" and error.value.key == str(tmp_path / "last.ckpt")
    assert "\n" not in str(error.value)


# --- full disks --------------------------------------------------------------------------------


def test_a_full_disk_leaves_the_checkpoint_before(surface, whole, tmp_path):
    import pytorch_lightning as pl

    save = pl.Trainer.save_checkpoint

    def full(self, path, *args, **extra):
        if self.global_step == 40:
            with open(path, "wb") as stream:
                stream.write(b"half of it")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        return save(self, path, *args, **extra)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pl.Trainer, "save_checkpoint", full)
        with pytest.raises(NsmError) as error:
            run(surface, tmp_path / "full")
    assert error.value.kind == "unwritable_file" and "\n" not in str(error.value)
    assert torch.load(tmp_path / "full" / "last.ckpt", weights_only=True)["global_step"] == 30
    assert not list((tmp_path / "full").glob("*.tmp"))
    run(surface, tmp_path / "full", resuming=True)
    assert same(weights(tmp_path / "full"), whole)


@pytest.mark.skipif(sys.platform == "win32", reason="needs limits of the system")
def test_a_real_limit_on_what_can_be_written(surface, tmp_path):
    """The system itself refuses: no file may pass 100 kB."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        with pytest.raises(NsmError) as error:
            run(surface, tmp_path, "map.width=256")
        assert error.value.kind == "unwritable_file"
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.glob("*.tmp")) and not (tmp_path / "last.ckpt").exists()


# --- two at once -------------------------------------------------------------------------------


def test_a_second_run_in_a_folder_is_refused_in_one_line(here, tmp_path):
    (tmp_path / "run").mkdir()
    holder = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import sys, filelock; lock = filelock.FileLock(sys.argv[1]); lock.acquire();"
            "print(1, flush=True); sys.stdin.read()",
            str(tmp_path / "run" / ".lock"),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert holder.stdout is not None
    try:
        assert holder.stdout.readline()
        result = here("surface=hemisphere", "hydra.run.dir=run", *WORDS[:3])
        assert result.returncode == 2
        assert len(result.stderr.strip().splitlines()) == 1
        assert [p.name for p in (tmp_path / "run").iterdir()] == [".lock"]
    finally:
        holder.kill()
        holder.wait()
    with folder_lock(tmp_path / "run"):  # the lock died with its process
        pass


# --- no memory ---------------------------------------------------------------------------------

SHORTAGES = {
    "torch": torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
    "CPU": RuntimeError("[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: not enough memory"),
    "Python": MemoryError(),
}


def scarce(monkeypatch, error, fits):
    """Evaluations of the network on more than ``fits`` points run out of memory."""
    from nsm.maps import NeuralMap

    evaluate = NeuralMap.value_and_jacobian

    def limited(self, x):
        if torch.is_grad_enabled() and len(x) > fits:
            raise error
        return evaluate(self, x)

    monkeypatch.setattr(NeuralMap, "value_and_jacobian", limited)


FEW = "trainer.max_steps=10"


@pytest.fixture(scope="module")
def few_steps(surface, tmp_path_factory):
    """A run of few steps on whole batches."""
    folder = tmp_path_factory.mktemp("few")
    run(surface, folder, FEW)
    assert told(folder) == {"rollbacks": [], "batch_parts": 1}
    return folder


@pytest.mark.parametrize("error", SHORTAGES.values(), ids=SHORTAGES.keys())
def test_a_batch_that_does_not_fit_is_halved_to_the_same_result(
    surface, few_steps, tmp_path, monkeypatch, error
):
    scarce(monkeypatch, error, fits=20)
    run(surface, tmp_path, FEW)
    assert told(tmp_path)["batch_parts"] == 4  # 64 points in parts of 16
    a, b = weights(few_steps), weights(tmp_path)
    for key in a:
        assert torch.allclose(a[key], b[key], rtol=1e-3, atol=1e-4), key


def test_gradients_of_parts_add_up_to_those_of_the_whole():
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(2, 8), torch.nn.Tanh(), torch.nn.Linear(8, 3))
    network.double()
    x = torch.rand(37, 2, dtype=torch.float64)
    gradients = []
    for parts in (1, 2, 8, 256):
        task = microbatching.Microbatching()
        task.microbatches = parts
        network.zero_grad()
        (y,) = task.pointwise(lambda part: (network(part),), x)
        ((y**2).sum() / y.abs().sum()).backward()  # no sum over points
        gradients.append(torch.cat([p.grad.flatten() for p in network.parameters()]))
    for other in gradients[1:]:
        assert (other - gradients[0]).abs().max() < 1e-14


def test_where_nothing_fits_it_is_an_error(surface, tmp_path, monkeypatch):
    scarce(monkeypatch, SHORTAGES["torch"], fits=0)
    with pytest.raises(NsmError) as error:
        run(surface, tmp_path)
    assert (error.value.kind, error.value.key) == ("out_of_memory", "data.batch_size")


def test_other_errors_are_not_taken_for_a_shortage(surface, tmp_path, monkeypatch):
    fault = RuntimeError("shapes do not fit")
    scarce(monkeypatch, fault, fits=0)
    with pytest.raises(RuntimeError) as error:
        run(surface, tmp_path)
    assert error.value is fault
