"""Where a training's curves, pictures and figures go: TensorBoard, CSV, W&B, MLflow."""

from __future__ import annotations

import csv
import importlib.util
import json
import math
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from pytorch_lightning.loggers import (
    CSVLogger,
    Logger,
    MLFlowLogger,
    TensorBoardLogger,
    WandbLogger,
)

from nsm.errors import NsmError
from nsm.instantiation import made_with, named_object
from nsm.results.files import as_json, atomic_write
from nsm.results.readable_settings import readable

# which run of W&B or MLflow a folder belongs to, so that resuming goes on with it
IDENTITY_FILE = "logger.json"


class TensorBoard(TensorBoardLogger):
    """Event files in the run folder, under ``tensorboard``: one run of TensorBoard for each job,
    without Lightning's curve of epochs.

    Args:
        folder: the run folder.
        first_step: where the training starts; what an interrupted one logged beyond is dropped.
    """

    def __init__(self, folder: str | Path, first_step: int = 0) -> None:
        _wait_for_a_later_name(Path(folder) / "tensorboard")
        super().__init__(
            folder,
            name="",
            version="tensorboard",
            default_hp_metric=False,
            purge_step=first_step,
        )

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        super().log_metrics({k: v for k, v in metrics.items() if k != "epoch"}, step)


def _wait_for_a_later_name(folder: Path) -> None:
    """Wait until a new event file comes last among those of a folder.

    TensorBoard reads them in the order of their names, which begin with the second of their
    creation; a file that is read out of turn drops what another has logged.
    """
    started = [int(file.name.split(".")[3]) for file in folder.glob("events.out.tfevents.*")]
    while started and time.time() < max(started) + 1:
        time.sleep(0.05)


class CSV(CSVLogger):
    """The curves as a table, ``csv/metrics.csv`` in the run folder.

    Args:
        folder: the run folder.
        first_step: where the training starts; rows beyond are dropped.
        every: steps between two values.
    """

    def __init__(self, folder: str | Path, first_step: int = 0, every: int = 25) -> None:
        file = Path(folder) / "csv" / "metrics.csv"
        earlier = []
        if first_step and file.is_file():
            with file.open(newline="") as stream:
                earlier = [row for row in csv.DictReader(stream) if int(row["step"]) < first_step]
        file.unlink(missing_ok=True)
        super().__init__(folder, name="", version="csv", flush_logs_every_n_steps=every)
        for row in earlier:
            step = int(row.pop("step"))
            self.log_metrics({name: float(value) for name, value in row.items() if value}, step)
        self.save()


class WandB(WandbLogger):
    """Weights & Biases (pip install wandb); WANDB_MODE=offline keeps the run on the disk.

    Args:
        folder: the run folder.
        project: what W&B calls so.
    """

    package = "wandb"

    def __init__(self, folder: str | Path, project: str = "nsm") -> None:
        place = Path(folder)
        known = _identity(place).get("wandb")
        super().__init__(project=project, name=place.name, id=known, save_dir=place)
        _identify(place, wandb=self.experiment.id)


class MLflow(MLFlowLogger):
    """MLflow (pip install mlflow).

    Args:
        folder: the run folder.
        project: what MLflow calls experiment.
        uri: of MLflow's server or store; None: that of MLFLOW_TRACKING_URI, or ``mlruns`` in the
            working folder.
    """

    package = "mlflow"

    def __init__(self, folder: str | Path, project: str = "nsm", uri: str | None = None) -> None:
        place = Path(folder)
        store = uri or os.environ.get("MLFLOW_TRACKING_URI") or Path("mlruns").absolute().as_uri()
        known = _identity(place).get("mlflow")
        super().__init__(project, run_name=place.name, run_id=known, tracking_uri=store)
        _identify(place, mlflow=self.run_id)


def build_loggers(settings: Mapping[str, Any], folder: Path, first_step: int) -> list[Logger]:
    """The loggers of a run, with its settings logged.

    Args:
        settings: of the run; ``logger`` has those of each logger, by any name.
        folder: the run folder, which exists.
        first_step: where the training starts.

    Raises:
        NsmError: a logger that cannot be made, or that is none of Lightning's.
    """
    flat, every = flattened(settings), settings["trainer"]["log_every"]
    loggers = []
    for name, own in settings["logger"].items():
        logger = made_with(own, folder=folder, first_step=first_step, every=every)
        if not isinstance(logger, Logger):
            raise NsmError(
                f"setting logger.{name}: a {type(logger).__name__} is no Lightning logger",
                kind="wrong_type",
                key=f"logger.{name}",
            )
        if first_step == 0 or not isinstance(logger, MLFlowLogger):  # takes each setting once
            logger.log_hyperparams(flat)
        loggers.append(logger)
    return loggers


def check_packages(settings: Mapping[str, Any]) -> None:
    """NsmError for a logger whose package is not installed, before any work is done.

    Args:
        settings: of the loggers, by name.
    """
    for name, own in settings.items():
        package = getattr(named_object(str(own["_target_"])), "package", None)
        if package and importlib.util.find_spec(package) is None:
            raise NsmError(
                f"setting logger.{name}: the package {package} is not installed; "
                f"pip install {package}",
                kind="missing_package",
                key=package,
            )


def _identity(folder: Path) -> dict[str, Any]:
    file = folder / IDENTITY_FILE
    return json.loads(file.read_text()) if file.is_file() else {}


def _identify(folder: Path, **identity: Any) -> None:
    atomic_write(folder / IDENTITY_FILE, as_json({**_identity(folder), **identity}))


class Distributed(Logger):
    """The loggers of several trainings in one batch: ``NAME@i`` goes to those of training i, as
    ``NAME``, and names without such an ending to all.

    Args:
        each: the loggers of each training.
    """

    def __init__(self, each: Sequence[Sequence[Logger]]) -> None:
        super().__init__()
        self.each = each

    @property
    def name(self) -> str | None:
        return None

    @property
    def version(self) -> str | None:
        return None

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        ended = [(*name.partition("@"), value) for name, value in metrics.items()]
        for index, loggers in enumerate(self.each):
            own = {name: value for name, at, i, value in ended if not at or int(i) == index}
            for logger in loggers:
                logger.log_metrics(own, step)

    def log_hyperparams(self, params: Any, *args: Any, **kwargs: Any) -> None:
        """Each logger has the settings of its own training."""

    def save(self) -> None:
        for logger in self.all():
            logger.save()

    def finalize(self, status: str) -> None:
        close(self.all(), status)

    def all(self) -> list[Logger]:
        """The loggers of all trainings."""
        return [logger for loggers in self.each for logger in loggers]


def loggers_of(loggers: Sequence[Logger], index: int) -> Sequence[Logger]:
    """The loggers of training ``index``, where there are several in one batch, or of the one."""
    first = loggers[0] if loggers else None
    return first.each[index] if isinstance(first, Distributed) else loggers


def takes_pictures(loggers: Sequence[Logger]) -> bool:
    """Whether pictures have a place in any of the logs."""
    kinds = (TensorBoardLogger, WandbLogger, MLFlowLogger)
    return any(isinstance(logger, kinds) for logger in _every(loggers))


def event_files(loggers: Sequence[Logger]) -> list[Any]:
    """The ``SummaryWriter`` of each TensorBoard among loggers, for what no other log takes."""
    every = _every(loggers)
    return [logger.experiment for logger in every if isinstance(logger, TensorBoardLogger)]


def _every(loggers: Sequence[Logger]) -> Sequence[Logger]:
    first = loggers[0] if loggers else None
    return first.all() if isinstance(first, Distributed) else loggers


def log_picture(loggers: Sequence[Logger], name: str, image: np.ndarray, step: int) -> None:
    """Put a picture (H, W, 3) uint8 into the logs that take pictures."""
    for logger in loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.add_image(name, image, step, dataformats="HWC")
        elif isinstance(logger, WandbLogger):
            logger.log_image(name, [image], step)
        elif isinstance(logger, MLFlowLogger):
            picture = Image.fromarray(image)
            logger.experiment.log_image(logger.run_id, picture, f"{name}/{step:07d}.png")


def log_figures(
    loggers: Sequence[Logger], settings: Mapping[str, Any], metrics: Mapping[str, Any], step: int
) -> None:
    """Put a run's final figures into its logs, beside its settings, and close them.

    TensorBoard's HPARAMS tab compares runs by them.
    """
    figures = {f"figures/{name}": value for name, value in headline(metrics).items()}
    for logger in loggers:
        logger.log_metrics(figures, step)
        if isinstance(logger, TensorBoardLogger):
            _compare(logger.experiment, settings, figures)
    close(loggers, "success")


def close(loggers: Sequence[Logger], status: str) -> None:
    """Write what is left; a W&B run would otherwise go on into the next one of a sweep."""
    for logger in loggers:
        logger.finalize(status)
        if isinstance(logger, WandbLogger):
            logger.experiment.finish(exit_code=0 if status == "success" else 1)


def _compare(writer: Any, settings: Mapping[str, Any], figures: dict[str, float]) -> None:
    """Make a run of TensorBoard a row of its HPARAMS tab: choices by name, settings, figures."""
    from torch.utils.tensorboard.summary import hparams

    flat = {k: _cell(v) for k, v in readable(settings).items() if v not in (None, {}, [])}
    # no experiment summary: TensorBoard takes the first that it finds for all runs, while without
    # one it unites the settings of all, with those that differ first
    _, start, end = hparams(flat, figures)
    writer.file_writer.add_summary(start)
    writer.file_writer.add_summary(end)


def _cell(value: Any) -> bool | int | float | str:
    return value if isinstance(value, (bool, int, float, str)) else str(value)


def headline(metrics: Mapping[str, Any]) -> dict[str, float]:
    """A run's figures as one row.

    Those of a parameterization are its own, without the methods it is compared with; those of a
    collection are the worst over its pairs.
    """
    row = {k: float(v) for k, v in metrics.items() if isinstance(v, (int, float))}
    row.update(metrics.get("nsm", {}))
    pairs = list(metrics.get("pairs", {}).values())
    for name in pairs[0] if pairs else ():
        worst = min if name == "covered_percent" else max
        row[f"{name}_worst"] = worst(pair[name] for pair in pairs)
    return {name: value for name, value in row.items() if math.isfinite(value)}


def flattened(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings with dotted names; lists, and what has no value, as text."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat.update(flattened(value, f"{name}."))
        else:
            flat[name] = _cell(value)
    return flat
