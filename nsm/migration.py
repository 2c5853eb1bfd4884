"""Names that settings had in earlier versions, and what they are called now.

A command line with an old name is answered with the new one. The stored configuration of an older
run is rewritten, so that its folder can still be loaded and resumed.
"""

from __future__ import annotations

from typing import Any

from nsm.errors import NsmError

# old key to new key; what follows an old key after a dot follows the new one
RENAMED = {
    "lambda": "loss_weights",
    "start": "initialization",
    "guarantee": "certification",
    "map.initialisation": "map.initialization",
    "map.readout": "map.linear_skip",
    "energy.lambda_normal": "loss_weights.normal",
    "constraints.lambda_injectivity": "loss_weights.injectivity",
    "constraints.lambda_boundary": "loss_weights.boundary",
    "constraints.lambda_landmarks": "loss_weights.landmarks",
    "constraints.lambda_seam": "loss_weights.seam",
    "constraints.lambda_triangles": "loss_weights.triangles",
    "data.vertex_share": "sampler.vertex_share",
    "data.domain_share": "sampler.domain_share",
    "data.pool": "sampler.pool",
    "logger.every": "trainer.log_every",
    "logger.pictures": "trainer.log_pictures",
    "logger.project": "logger.wandb.project",
    "logger.uri": "logger.mlflow.uri",
}
# old option to new option
OPTIONS: dict[tuple[str, str], tuple[str, str]] = {
    ("hydra/launcher", "together"): ("hydra/launcher", "batched"),
    ("sweep", "lambda_normal"): ("sweep", "normal_weight"),
    ("sweep", "lambda_seam"): ("sweep", "seam_weight"),
    ("energy", "overfit"): ("loss_weights", "overfit"),
}
# of groups whose options were names with parameters: name to ``_target_``
_ACTIVATIONS = "nsm.maps.activations."
_ENCODINGS = "nsm.maps.encodings."
_SCHEDULES = "nsm.tasks.schedules."
_LOGGERS = "nsm.results.loggers."
TARGETS: dict[str, dict[str, str]] = {
    "activation": {
        "softplus": _ACTIVATIONS + "Softplus",
        "relu": _ACTIVATIONS + "ReLU",
        "leaky_relu": _ACTIVATIONS + "LeakyReLU",
        "silu": _ACTIVATIONS + "SiLU",
        "gelu": _ACTIVATIONS + "GELU",
        "tanh": _ACTIVATIONS + "Tanh",
        "elu": _ACTIVATIONS + "ELU",
        "sine": _ACTIVATIONS + "Sine",
    },
    "encoding": {
        "spline_grid": _ENCODINGS + "SplineGrid",
        "fourier": _ENCODINGS + "RandomFourierFeatures",
        "identity": _ENCODINGS + "Identity",
    },
    "optimizer": {
        "adam": "torch.optim.Adam",
        "adamw": "torch.optim.AdamW",
        "rmsprop": "torch.optim.RMSprop",
        "sgd": "torch.optim.SGD",
        "lbfgs": "torch.optim.LBFGS",
        "muon": "nsm.tasks.optimizers.MuonBesideAdam",
    },
    "scheduler": {
        "constant": _SCHEDULES + "Constant",
        "cosine": _SCHEDULES + "Cosine",
        "sgdr": _SCHEDULES + "SGDR",
    },
    "domain": {"disc": "nsm.domains.Disc", "square": "nsm.domains.Square"},
    "task": {
        "overfit": "nsm.pipeline.overfit.OverfitTask",
        "param": "nsm.pipeline.param.ParamTask",
        "pair_map": "nsm.pipeline.pair_map.PairMapTask",
        "collection_map": "nsm.pipeline.collection_map.CollectionMapTask",
    },
    "logger": {
        "tensorboard": _LOGGERS + "TensorBoard",
        "csv": _LOGGERS + "CSV",
        "wandb": _LOGGERS + "WandB",
        "mlflow": _LOGGERS + "MLflow",
    },
}
_NAMED = ("activation", "encoding", "optimizer", "scheduler", "task")


def check_override(key: str, value: str) -> None:
    """NsmError, with the new name, for an override whose setting or option has another name now."""
    bare = key.lstrip("+~")
    group, _, last = bare.rpartition(".")
    new = {
        "logger.kinds": "logger=tensorboard, csv, both, wandb, mlflow or none",
        "trainer": "trainer.SETTING=VALUE, as it is no group any more"
        if value == "default"
        else "",
    }.get(bare)
    if last == "name" and value in TARGETS.get(group, ()):
        new = f"{group}={value}"
    for option in value.split(","):
        new = "=".join(OPTIONS[bare, option]) if (bare, option) in OPTIONS else new
    for old, name in RENAMED.items():
        if bare == old or bare.startswith(f"{old}."):
            new = f"{name}{bare[len(old) :]}={value}"
    if new:
        message = f"{key}={value}: it has another name now; give {new}"
        raise NsmError(message, kind="renamed_setting", key=bare)


def check_weights(key: str) -> None:
    """NsmError, with the new form, for ``energy.weights`` of an energy that is no blend."""
    if key == "energy.weights":
        message = "a blend is an energy; give energy._target_=nsm.energies.Blend with them"
        raise NsmError(f"setting {key}: {message}", kind="renamed_setting", key=key)


def migrated(settings: Any) -> dict[str, Any]:
    """The settings of an older run, as this version has them; those of this version unchanged.

    Args:
        settings: of the file ``config.yaml`` of a run folder.

    Raises:
        ValueError: no settings of any version.
    """
    if "_target_" in _mapping(settings, "task"):
        return dict(settings)
    old = dict(settings)
    for key in ("domain", "map", "data", "energy", "logger", "trainer", *_NAMED):
        if key not in old:
            raise ValueError(f"it has no {key}")
    name = str(old["task"].get("name"))
    energy, constraints = _mapping(old, "energy"), _mapping(old, "constraints")
    logger, data, network = (_mapping(old, key) for key in ("logger", "data", "map"))
    shares = {key: data.pop(key) for key in ("vertex_share", "domain_share", "pool") if key in data}
    for key in ("initialisation", "readout"):
        if key in network:
            network[RENAMED[f"map.{key}"].rpartition(".")[2]] = network.pop(key)
    weights = {k: v for k, v in {**energy, **constraints}.items() if k.startswith("lambda_")}
    held = {key: value for key, value in constraints.items() if key not in weights}
    kinds = {k: {"_target_": _target("logger", k)} for k in logger.get("kinds", ())}
    for kind, key in (("wandb", "project"), ("mlflow", "project"), ("mlflow", "uri")):
        if kind in kinds and key in logger:
            kinds[kind][key] = logger[key]
    logged = {f"log_{k}": logger[k] for k in ("every", "pictures") if k in logger}
    blend = {"_target_": "nsm.energies.Blend", "weights": energy.get("weights")}
    kind = "CollectionData" if name == "collection_map" else "SurfaceData"
    named = {}
    for group in _NAMED:
        rest = _mapping(old, group)
        named[group] = {"_target_": _target(group, rest.pop("name", None)), **rest}
    named["task"]["name"] = name
    return {
        **{key: value for key, value in old.items() if key != "guarantee"},
        **named,
        "certification": old.get("guarantee", old.get("certification", {})),
        "map": {"_target_": "nsm.maps.NeuralMap", **network},
        "domain": {"_target_": _target("domain", old["domain"])},
        "energy": blend if "weights" in energy else None,
        "loss_weights": {key.removeprefix("lambda_"): value for key, value in weights.items()},
        "constraints": held or None,
        "sampler": {"_target_": "nsm.data.Sampler", **shares},
        "data": {"_target_": f"nsm.data.{kind}", **data},
        "logger": kinds,
        "trainer": {**_mapping(old, "trainer"), **logged},
    }


def _mapping(settings: Any, key: str) -> dict[str, Any]:
    """A copy of a nested mapping; empty if there is none."""
    value = settings.get(key)
    if value is not None and not isinstance(value, dict):
        raise ValueError(f"{key} is no mapping")
    return dict(value or {})


def _target(group: str, name: Any) -> str:
    """The ``_target_`` of an option's old name; one that a user registered keeps it."""
    if str(name) in TARGETS[group]:
        return TARGETS[group][str(name)]
    if group in ("activation", "encoding"):
        return f"nsm.extensions.registered.{name}"
    raise ValueError(f"{group} {str(name)[:60]!r} is not known")
