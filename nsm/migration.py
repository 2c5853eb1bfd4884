"""Names that settings had in earlier versions, and what they are called now.

A command line with an old name is answered with the new one. The stored configuration of an older
run is rewritten, so that its folder can still be loaded and resumed.
"""

from __future__ import annotations

from collections.abc import Mapping
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
# old option to new option; None: the group has no such option any more
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
    for old, new in RENAMED.items():
        if bare == old or bare.startswith(f"{old}."):
            raise _renamed(bare, f"{key}={value}", f"{new}{bare[len(old) :]}={value}")
    for option in value.split(","):
        if (bare, option) in OPTIONS:
            group, name = OPTIONS[bare, option]
            raise _renamed(bare, f"{key}={value}", f"{group}={name}")
    group, _, last = bare.rpartition(".")
    if last == "name" and group in _NAMED:
        raise _renamed(bare, f"{key}={value}", f"{group}={value}")
    if bare == "logger.kinds":
        raise _renamed(
            bare, f"{key}={value}", "logger=tensorboard, csv, both, wandb, mlflow or none"
        )
    if bare == "trainer":
        raise _renamed(bare, f"{key}={value}", "trainer.SETTING=VALUE; it is no group any more")


def _renamed(key: str, given: str, new: str) -> NsmError:
    return NsmError(
        f"{given}: it has another name now; give {new}", kind="renamed_setting", key=key
    )


def migrated(settings: Any) -> dict[str, Any]:
    """The settings of an older run, as this version has them; those of this version unchanged.

    Args:
        settings: of the file ``config.yaml`` of a run folder.

    Raises:
        ValueError: no settings of any version.
    """
    if "_target_" in _mapping(settings, "task"):
        return dict(settings)
    old: dict[str, Any] = {key: value for key, value in settings.items()}
    for key in ("domain", "map", "data", "energy", "logger", "trainer", *_NAMED):
        if key not in old:
            raise ValueError(f"it has no {key}")
    name = str(old["task"].get("name"))
    energy, constraints = _mapping(old, "energy"), _mapping(old, "constraints")
    logger, data = _mapping(old, "logger"), _mapping(old, "data")
    shares = {key: data.pop(key) for key in ("vertex_share", "domain_share", "pool") if key in data}
    weights = {**energy, **constraints}
    kind = "CollectionData" if name == "collection_map" else "SurfaceData"
    new: dict[str, Any] = {
        **old,
        "map": {"_target_": "nsm.maps.NeuralMap", **_mapping(old, "map")},
        "domain": {"_target_": _target("domain", old["domain"])},
        "energy": None,
        "loss_weights": {
            key.removeprefix("lambda_"): value
            for key, value in weights.items()
            if key.startswith("lambda_")
        },
        "constraints": {k: v for k, v in constraints.items() if not k.startswith("lambda_")}
        or None,
        "sampler": {"_target_": "nsm.data.Sampler", **shares},
        "data": {"_target_": f"nsm.data.{kind}", **data},
        "logger": {
            k: {"_target_": _target("logger", k), **_logger_settings(k, logger)}
            for k in logger.get("kinds", ())
        },
        "trainer": {
            **_mapping(old, "trainer"),
            **{f"log_{k}": logger[k] for k in ("every", "pictures") if k in logger},
        },
    }
    if "weights" in energy:
        new["energy"] = {"_target_": "nsm.energies.Blend", "weights": energy["weights"]}
    for group in _NAMED:
        rest = _mapping(old, group)
        given = rest.pop("name", None)
        new[group] = {"_target_": _target(group, given), **rest}
    new["task"]["name"] = name
    new["map"].update(_renamed_keys("map", new["map"]))
    if "guarantee" in new:
        new["certification"] = new.pop("guarantee")
    return {key: value for key, value in new.items() if key not in ("initialisation", "readout")}


def _renamed_keys(group: str, settings: dict[str, Any]) -> dict[str, Any]:
    """Settings of a group with their new names; the old ones are taken out."""
    return {
        RENAMED[f"{group}.{key}"].rpartition(".")[2]: settings.pop(key)
        for key in list(settings)
        if f"{group}.{key}" in RENAMED
    }


def _logger_settings(kind: str, logger: Mapping[str, Any]) -> dict[str, Any]:
    takes = {"wandb": ("project",), "mlflow": ("project", "uri")}.get(kind, ())
    return {key: logger[key] for key in takes if key in logger}


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
