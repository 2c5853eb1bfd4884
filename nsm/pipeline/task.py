"""What a task is, in one place: module, data, result, defaults, and how they are made."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytorch_lightning as pl
import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.text import Text

from nsm.domains import Surface, domain
from nsm.errors import NsmError
from nsm.instantiation import made, made_with
from nsm.maps import AnalyticSurface, Tabulated
from nsm.pipeline.automatic_domain import choose_domain, is_automatic
from nsm.pipeline.training import plain
from nsm.results import NeuralSurface
from nsm.results.meshes import ColouredMesh
from nsm.tasks.training import Training


@dataclass(frozen=True)
class Given:
    """Inputs that a caller has at hand, instead of those that the configuration names.

    Attributes:
        surface: of task=overfit, prepared, or as :meth:`Surface.load` takes it.
        phi: of task=param, a neural surface, or as ``surface``.
        source, target: of task=pair_map, as :func:`nsm.pipeline.resolve_inputs.read_shape` takes
            them.
        surfaces: of task=collection_map, as :func:`nsm.pipeline.collection_inputs.collected` takes
            them.
        template: of task=collection_map, as ``source``.
        landmarks: as :func:`nsm.pipeline.landmark_inputs.landmark_vertices` takes them.
    """

    surface: Any = None
    phi: Any = None
    source: Any = None
    target: Any = None
    surfaces: Any = None
    template: Any = None
    landmarks: Any = None


class Task:
    """Base of the tasks; :func:`nsm.pipeline.run_task` runs them.

    A user's own is chosen with ``task._target_=mypackage.MyTask``. It names the classes below,
    sets ``surface`` in ``prepare``, and defines ``build``, ``make_result`` and what else it needs;
    the rest has defaults.

    Args:
        name: of the task, which run folders and logs show.

    Attributes:
        module: the LightningModule that is trained.
        data: the DataModule of the default configuration.
        result: what a run returns; it has ``save(folder)``, and, if the task is certified,
            ``certificate`` and ``repaired()``.
        defaults: the option of the group ``task`` with the default configuration.
        certified: the result is checked for injectivity and repaired.
        closed_domains: it works on domains without boundary too.
        parts_into_wholes: it maps an open source into a closed target.
        table: from the figures to a table to print, or None.
        picture_name: of the pictures in the log.
        config: of the run.
        domain: Ω.
        console: where to print.
        folder: where ``prepare`` may leave pictures of its inputs, once they are known to be good;
            None: nowhere.
        surface: the surface whose name and preparation metrics.json reports.
        trained: if the task is certified, the result as it was trained, before any repair; None
            before that.
    """

    module: ClassVar[type[Training]]
    data: ClassVar[type[pl.LightningDataModule]]
    result: ClassVar[type]
    defaults: ClassVar[str]
    certified: ClassVar[bool] = False
    closed_domains: ClassVar[bool] = False
    parts_into_wholes: ClassVar[bool] = False
    table: ClassVar[Callable[..., Any] | None] = None
    picture_name: ClassVar[str] = "surface"
    config: DictConfig
    domain: Any  # nsm.domains.Domain; maps need more of it than a domain without boundary has
    console: Console
    surface: Surface
    folder: Path | None = None
    trained: Any = None

    def __init__(self, name: str = "task") -> None:
        self.name = name

    @property
    def title(self) -> str:
        """What is trained, for the progress bar."""
        return f"{self.name} {self.surface.name}"

    def setup(self, config: DictConfig, console: Console) -> None:
        """Take the settings of a run.

        Raises:
            NsmError: ``wrong_domain``: the task needs a domain with boundary.
        """
        self.config, self.console = config, console
        if is_automatic(config.domain):
            return  # until the inputs are known
        self.domain = domain(config.domain)
        if not (self.domain.has_boundary or self.closed_domains):
            raise NsmError(
                f"domain={self.domain} has no boundary, which task={self.name} needs: take "
                "domain=disc",
                kind="wrong_domain",
                key="domain",
            )

    @property
    def settings(self) -> dict[str, Any]:
        """The configuration as plain dictionaries and lists."""
        return plain(self.config)

    def keep_absolute(self, *keys: str) -> None:
        """Make the paths in settings absolute: a run can then be resumed from any folder."""
        for key in keys:
            self.config[key] = _absolute(self.settings[key])

    def inputs(self, given: Given) -> list[Any]:
        """The surfaces that the run is given, as settings or callers name them, which say what
        ``domain=auto`` is; with none, it is the disc."""
        return []

    def choose_domain(self, given: Given) -> None:
        """Put the domain that suits the inputs in place of ``domain=auto``.

        Raises:
            NsmError: an input that cannot be used.
        """
        if is_automatic(self.config.domain):
            how = {"closed": self.closed_domains, "parts": self.parts_into_wholes}
            choose_domain(self.config, self.inputs(given), self.console, **how)
            self.setup(self.config, self.console)

    def prepare(self, given: Given) -> None:
        """Find and prepare the inputs, and set ``surface``; the configuration's paths become
        absolute, so that a run can be resumed from any folder.

        Raises:
            NsmError: an input that cannot be used.
        """
        raise NotImplementedError

    def build(self) -> Training:
        """The module to train, with the seeded random state.

        Raises:
            ValueError, TypeError, NsmError: settings that do not fit together.
        """
        raise NotImplementedError

    def shared_settings(self) -> dict[str, Any]:
        """The arguments that the modules of all tasks take from the settings."""
        groups = ("map", "activation", "encoding", "optimizer", "scheduler")
        settings = self.settings
        return {
            **{name: settings[name] for name in (*groups, "loss_weights", "loss_terms")},
            "max_steps": settings["trainer"]["max_steps"],
        }

    def map_settings(self) -> dict[str, Any]:
        """The arguments that the modules of planar maps take from the settings."""
        return {
            **self.shared_settings(),
            "constraints": self.settings["constraints"],
            "energy": made(self.config.energy),
            "domain": self.domain,
        }

    @property
    def data_settings(self) -> dict[str, Any]:
        """The settings of the group ``data``."""
        return dict(self.settings["data"])

    def build_data(self) -> pl.LightningDataModule:
        """The samples of the training."""
        return self.made_data(surface=self.surface)

    def made_data(self, **inputs: Any) -> pl.LightningDataModule:
        """The configured DataModule, with inputs, sampler and seed."""
        sampler = made(self.config.sampler)
        data: pl.LightningDataModule = made_with(
            self.data_settings, **inputs, sampler=sampler, seed=self.config.seed
        )
        return data

    def tabulated(self, surface: NeuralSurface) -> torch.nn.Module:
        """A surface whose points move in the training, as that evaluates it."""
        cells = self.config.trainer.tabulated
        if cells is None or isinstance(surface.map, AnalyticSurface):  # whose formulas are as fast
            return surface.map
        return Tabulated(surface.map, cells, periodic=not self.domain.has_boundary)

    def begin_again(self, module: Any) -> bool:
        """Whether a trained module shows that another start is needed; the settings then have it.

        The task says so. A run that is resumed begins with the start in its settings.
        """
        return False

    def parts(self) -> list[Task]:
        """Tasks of which this one consists, prepared, to be run one by one in folders of their own
        (see :func:`nsm.pipeline.runner.run_parts`); none: it is trained itself."""
        return []

    def joined(self, results: list[Any]) -> Any:
        """The result of a task that consists of parts, from theirs."""
        raise NotImplementedError

    def inner_line(self, result: Any) -> str:
        """What is printed of a part of a task, after the surface's name; "" for a neural surface,
        whose line the runner has."""
        return ""

    def make_result(self, module: Any) -> Any:
        """The result of a module as it stands."""
        raise NotImplementedError

    def measure(self, result: Any) -> None:
        """Put the figures into ``result.metrics``."""

    def warnings(self, result: Any) -> list[Text]:
        """What is said after the figures, where the result is not what a user would expect."""
        return []

    def figures(self, result: Any) -> dict[str, Any]:
        """What metrics.json says beside ``metrics``, such as the names of inputs."""
        return {}

    def picture(self, module: Any) -> np.ndarray | None:
        """A picture (H, W, 3) uint8 of the module as it stands, for the log; None: none."""
        return None

    def mesh(self, module: Any) -> ColouredMesh | None:
        """The same as a mesh; None: none."""
        return None

    def save(self, folder: Path, result: Any) -> None:
        """Write the result into the run folder."""
        result.save(folder)

    def write_artefacts(self, folder: Path, result: Any) -> None:
        """Write pictures and exported meshes into the run folder."""


def frozen(network: torch.nn.Module) -> Any:
    """A copy of a trained network as results hold it: on the CPU, without gradients."""
    return copy.deepcopy(network).cpu().eval().requires_grad_(False)


def _absolute(given: Any) -> Any:
    """A setting with each path in it that exists made absolute."""
    if isinstance(given, str):
        return os.path.abspath(given) if Path(given).exists() else given
    if isinstance(given, dict):
        return {key: _absolute(value) for key, value in given.items()}
    if isinstance(given, list):
        return [_absolute(item) for item in given]
    return given
