"""experiment=paper has the settings of the paper, and says of each where it comes from."""

import re
from functools import cache

import pytest
import torch
from omegaconf import OmegaConf

from nsm.config import compose_config, conf_folder
from nsm.maps import NeuralMap
from nsm.tasks.schedules import build_scheduler

TASKS = ("overfit", "param", "pair_map", "collection_map")
TEXT, CODE, OURS = "text", "authors' code", "ours"
# setting -> its value, whose it is, and the words of METHOD that say so; None: METHOD says that
# neither text nor code do, or the value states that a term or step of ours is absent
SHARED = {
    "domain._target_": ("nsm.domains.Disc", TEXT, "Ω ⊂ R² is the unit disc"),
    "activation._target_": ("nsm.maps.activations.Softplus", TEXT, "256 wide, softplus"),
    "activation.beta": (1.0, TEXT, None),
    "map.initialization": ("xavier", TEXT, "Xavier normal"),
    "map.linear_skip": ("none", TEXT, "Xavier normal"),
    "encoding._target_": ("nsm.maps.encodings.Identity", TEXT, "φ: ten-layer residual fully"),
    "optimizer._target_": ("torch.optim.RMSprop", TEXT, "RMSProp, lr 1e-4, momentum 0.9"),
    "optimizer.lr": (1e-4, TEXT, "RMSProp, lr 1e-4, momentum 0.9"),
    "optimizer.momentum": (0.9, TEXT, "RMSProp, lr 1e-4, momentum 0.9"),
    "scheduler._target_": ("nsm.tasks.schedules.SGDR", TEXT, "SGDR warm restarts"),
    "trainer.stop_gradient_norm": (0.1, TEXT, "when the gradient norm falls under 0.1"),
    "trainer.stop_norm_of": ("sum", CODE, "the code *sums* over the batch"),
    "trainer.stop_window": (100, OURS, None),
    "trainer.gradient_clip": (None, OURS, None),
    "trainer.threads": (None, OURS, None),
}
OVERFIT = {
    "map.width": (256, TEXT, "ten-layer residual fully connected, 256 wide"),
    "map.depth": (10, TEXT, "ten residual blocks of two linear layers each"),
    "map.block": ("post", TEXT, "ten-layer residual fully connected"),
    "loss_weights.normal": (0.01, TEXT, "λ_n = 0.01"),
    "data.batch_size": (4000, CODE, "all mesh vertices plus 4,000 samples (overfit)"),
    "data.steps_per_epoch": (50, OURS, None),
    "sampler.every_vertex": (True, CODE, "all mesh vertices plus 4,000 samples (overfit)"),
    "sampler.vertex_share": (0.0, CODE, "all mesh vertices plus 4,000 samples (overfit)"),
    "sampler.pool": (500_000, TEXT, "500k points, uniform on the mesh"),
    "trainer.max_steps": (50_000, CODE, "50k and 80k steps"),
}
PARAM = {
    "map.width": (128, TEXT, "h: four layers of 128, softplus"),
    "map.depth": (3, TEXT, "h: four layers of 128, softplus"),
    "map.block": ("plain", CODE, "h is a plain MLP pretrained to the identity"),
    "phi.overrides": (["experiment=paper"], TEXT, None),
    "energy._target_": ("nsm.energies.SymmetricDirichlet", TEXT, "Symmetric Dirichlet (Eq. 2)"),
    "constraints.boundary": ("free", TEXT, "h: Ω → R², free boundary"),
    "constraints.injectivity": ("exponential", TEXT, None),
    "constraints.triangles_from": (1.0, TEXT, None),
    "sampler.stratified": (False, TEXT, "500k points, uniform on the mesh"),
    "loss_weights.injectivity": (1e2, TEXT, "λ_inv = 1e2"),
    "loss_weights.triangles": (0.0, TEXT, None),
    "data.batch_size": (1024, CODE, "1,024 (maps)"),
    "data.steps_per_epoch": (250, OURS, None),
    "certification.repair": (False, TEXT, None),
    "trainer.log_every": (25, OURS, None),
    "trainer.tabulated": (None, TEXT, None),
    "trainer.max_steps": (80_000, CODE, "50k and 80k steps"),
}
PAIR = {
    **PARAM,
    "seam.path": ("own", OURS, None),
    "constraints.boundary": ("penalty", TEXT, "Boundary (B): λ_B"),
    "constraints.landmarks": ("fixed", TEXT, "λ_C Σ‖h(P_i) − Q_i‖²"),
    "constraints.ramp": (0.0, TEXT, None),
    "loss_weights.boundary": (1e6, TEXT, "λ_B = 1e6 in the paper"),
    "loss_weights.landmarks": (1e3, TEXT, "λ_C = 1e3"),
    "loss_weights.seam": (0.0, TEXT, None),
}
COLLECTION = {
    **PAIR,
    "constraints.pairs": ("sum", TEXT, "The sum of distortions over *all ordered pairs*"),
}
PAPER = {
    "overfit": {**SHARED, **OVERFIT},
    "param": {**SHARED, **PARAM},
    "pair_map": {**SHARED, **PAIR},
    "collection_map": {**SHARED, **COLLECTION},
}
# settings whose values are those of the task, or of the option that a labelled line chooses
OF_THE_TASK = {"energy._target_", "constraints.boundary"}


def labelled(*files):
    """Setting or chosen group -> whose it is, from the remarks of files in conf/."""
    found = {}
    for file in files:
        section = ""
        for line in (conf_folder() / file).read_text(encoding="utf-8").splitlines():
            match = re.match(r"( *)(?:- override /)?(\w+):(?: +([^#]*[^# ]))?(?: +# (.*))?$", line)
            if match is None or match[2] == "defaults":
                continue
            indent, key, value, remark = match.groups()
            if value is None:
                section = f"{key}."
                continue
            name = key if "- override" in line or not indent else f"{section}{key}"
            whose = [word for word in (TEXT, CODE, OURS) if (remark or "").startswith(word)]
            assert whose or name == "published", f"{file}: {line.strip()}"
            found[name] = whose[0] if whose else None
    return found


CHAINS = {
    "overfit": ["published/overfit.yaml"],
    "param": ["published/param.yaml"],
    "pair_map": ["published/param.yaml", "published/pair_map.yaml"],
    "collection_map": [
        "published/param.yaml",
        "published/pair_map.yaml",
        "published/collection_map.yaml",
    ],
}


@cache
def paper(task):
    return compose_config([f"task={task}", "experiment=paper"])


@pytest.mark.parametrize("task", TASKS)
def test_the_settings_are_the_papers(task):
    config = paper(task)
    labels = labelled("experiment/paper.yaml", *CHAINS[task])
    for key, (value, whose, _) in PAPER[task].items():
        assert (key, OmegaConf.select(config, key, throw_on_missing=True)) == (key, value)
        if key not in OF_THE_TASK:
            stated = labels.get(key) or labels[key.partition(".")[0]]
            assert (key, stated) == (key, whose)


@pytest.mark.parametrize("task", TASKS)
def test_every_setting_of_the_files_is_in_the_table(task):
    groups = {key.partition(".")[0] for key in PAPER[task]}
    for name in labelled("experiment/paper.yaml", *CHAINS[task]):
        assert name in PAPER[task] or name in groups | {"published", "initialization"}


def test_the_table_quotes_the_method(shared_meshes):
    file = shared_meshes.parent / "METHOD.md"
    if not file.is_file():
        pytest.skip("no METHOD.md beside the folder of classic models")
    method = " ".join(file.read_text(encoding="utf-8").split())
    for settings in PAPER.values():
        for key, (_, _, words) in settings.items():
            assert words is None or words in method, f"{key}: {words}"


def test_the_pool_of_samples_has_one_size():
    assert compose_config(["sampler=pool"]).sampler.pool == paper("overfit").sampler.pool


@pytest.mark.parametrize("task", TASKS[1:])
def test_the_surfaces_of_maps_are_the_papers(task):
    config = paper(task)
    phi = compose_config(["task=overfit", *config.phi.overrides])
    assert phi == paper("overfit")


def test_h_has_four_layers_of_128():
    settings = {k: v for k, v in paper("param").map.items() if k != "_target_"}
    layers = NeuralMap(out_dim=2, **settings).layers
    assert [one.in_features for one in layers] == [2, 128, 128, 128, 128]
    assert [one.out_features for one in layers] == [128, 128, 128, 128, 2]


def test_a_setting_on_the_command_line_goes_before_the_papers():
    config = compose_config(["task=param", "experiment=paper", "map.width=16", "optimizer=adam"])
    assert config.map.width == 16
    assert config.optimizer._target_ != "torch.optim.RMSprop"
    assert compose_config(["experiment=paper", "domain=square"]).domain._target_.endswith("Square")


@pytest.mark.parametrize("task", TASKS)
def test_the_schedule_ends_with_the_training(task):
    config = paper(task)
    steps = config.trainer.max_steps
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
    schedule = build_scheduler(optimizer, OmegaConf.to_container(config.scheduler), steps)
    assert schedule.wave_ends(steps) and not schedule.wave_ends(steps // 2)
