"""Sweepers: which jobs a sweep consists of."""

from __future__ import annotations

import difflib
import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import IntervalSweep, Override, RangeSweep
from hydra.core.plugins import Plugins
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from nsm.errors import NsmError
from nsm.optional_dependencies import needed
from nsm.sweeps import Outcome, overrides_of

_SAMPLERS = {
    "tpe": "TPESampler",
    "gp": "GPSampler",
    "qmc": "QMCSampler",
    "random": "RandomSampler",
}
_DIRECTIONS = ("minimize", "maximize")
_STUDY_FILE, _BEST_FILE = "optuna.journal", "best.json"


class _JobSweeper(Sweeper):
    """Base of the sweepers: takes the configuration and makes the launcher."""

    config: DictConfig
    launcher: Launcher

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.config, self.loader = config, hydra_context.config_loader
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )


class Grid(_JobSweeper):
    """All combinations of the values of a sweep.

    Args:
        max_batch_size: jobs that the launcher gets at once; None: all.
        params: what is swept, besides the overrides of the command: {seed: "0,1,2"}.
    """

    def __init__(self, max_batch_size: int | None, params: dict[str, str] | None) -> None:
        self.max_batch_size, self.params = max_batch_size, params

    def sweep(self, arguments: list[str]) -> None:
        """Run the jobs.

        Raises:
            NsmError: an interval, which has no list of values, or settings that cannot be used.
        """
        values = []
        for override in overrides_of(arguments, self.params, self.loader):
            key = override.get_key_element()
            if override.is_discrete_sweep():
                values.append([f"{key}={value}" for value in override.sweep_string_iterator()])
            elif override.is_sweep_override():
                raise NsmError(
                    f"{override.input_line}: a grid needs values, {key}=A,B; an interval goes with "
                    "hydra/sweeper=optuna",
                    kind="wrong_type",
                    key=key,
                )
            else:
                values.append([str(override.input_line)])
        jobs = [list(job) for job in itertools.product(*values)]
        size = self.max_batch_size or len(jobs)
        for first in range(0, len(jobs), size):
            self.launcher.launch(jobs[first : first + size], initial_job_idx=first)


class Optuna(_JobSweeper):
    """Trials that Optuna chooses by the figures of earlier ones.

    The sweep's folder keeps the study: run again, the sweep continues until it has ``n_trials``
    complete trials, with those that failed or were interrupted first.

    Args:
        n_trials: complete trials in all, those of earlier runs included.
        n_jobs: trials at a time.
        objective: the figure that decides, as a dotted key of metrics.json.
        direction: ``minimize`` or ``maximize``.
        sampler: ``tpe``, ``gp``, ``qmc`` or ``random``.
        seed: of the sampler.
        params: what is swept, besides the overrides of the command:
            {optimizer.lr: "interval(1e-4, 1e-1)"}.
    """

    def __init__(
        self,
        n_trials: int,
        n_jobs: int,
        objective: str,
        direction: str,
        sampler: str,
        seed: int,
        params: dict[str, str] | None,
    ) -> None:
        self.n_trials, self.n_jobs, self.objective = n_trials, n_jobs, objective
        self.direction, self.sampler, self.seed = direction, sampler, seed
        self.params = params

    def sweep(self, arguments: list[str]) -> None:
        """Run the trials, and leave the best one's overrides, figure and folder in best.json.

        Raises:
            NsmError: nothing is swept, or the objective is not a figure of the task.
        """
        self._check()
        optuna = needed("optuna", "hydra/sweeper=optuna")
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        overrides = overrides_of(arguments, self.params, self.loader)
        space = {
            o.get_key_element(): _distribution(optuna, o)
            for o in overrides
            if o.is_sweep_override()
        }
        if not space:
            raise NsmError(
                "hydra/sweeper=optuna: nothing to choose; give optimizer.lr=interval(a,b)",
                kind="missing_setting",
                key="hydra/sweeper",
            )
        fixed = [
            f"{o.get_key_element()}={o.get_value_element_as_str()}"
            for o in overrides
            if not o.is_sweep_override()
        ]
        folder = Path(self.config.hydra.sweep.dir)
        study = self._study(optuna, folder)
        to_go = self.n_trials - len(_complete(optuna, study))
        first = len(study.trials)
        while to_go > 0:
            trials = [study.ask(space) for _ in range(min(self.n_jobs, to_go))]
            chosen = [[*fixed, *_overrides(trial.params)] for trial in trials]
            returns = self.launcher.launch(chosen, initial_job_idx=first)
            for trial, returned in zip(trials, returns, strict=True):
                self._tell(optuna, study, trial, returned.return_value)
            to_go, first = to_go - len(trials), first + len(trials)
        self._close(optuna, study, folder)

    def _check(self) -> None:
        known = {"sampler": (self.sampler, _SAMPLERS), "direction": (self.direction, _DIRECTIONS)}
        for name, (given, names) in known.items():
            if given not in names:
                key = f"hydra.sweeper.{name}"
                near = difflib.get_close_matches(given, names, n=1, cutoff=0.0)[0]
                message = f"setting {key}: {given!r}; did you mean {near!r}?"
                raise NsmError(message, kind="unknown_option", key=key)
        for name, count in (("n_trials", self.n_trials), ("n_jobs", self.n_jobs)):
            if count < 1:
                key = f"hydra.sweeper.{name}"
                message = f"setting {key}: it must be at least 1"
                raise NsmError(message, kind="out_of_range", key=key)

    def _study(self, optuna: Any, folder: Path) -> Any:
        folder.mkdir(parents=True, exist_ok=True)
        storages = optuna.storages
        journal = storages.journal.JournalFileBackend(str(folder / _STUDY_FILE))
        study = optuna.create_study(
            study_name="nsm",
            storage=storages.JournalStorage(journal),
            direction=self.direction,
            load_if_exists=True,
        )
        # other random numbers than those of the earlier trials
        sampler = getattr(optuna.samplers, _SAMPLERS[self.sampler])
        study.sampler = sampler(seed=self.seed + len(study.trials))
        states = optuna.trial.TrialState
        again = study.get_trials(states=(states.RUNNING, states.FAIL))
        for trial in again:
            if trial.state == states.RUNNING:  # it was interrupted
                study.tell(trial.number, state=states.FAIL)
        done = [trial.params for trial in _complete(optuna, study)]
        for params in {str(trial.params): trial.params for trial in again}.values():
            if params not in done:
                study.enqueue_trial(params, skip_if_exists=False)
        return study

    def _tell(self, optuna: Any, study: Any, trial: Any, outcome: Outcome) -> None:
        trial.set_user_attr("folder", outcome.folder.name)
        value = None if outcome.error else _figure(outcome.folder, self.objective)
        if value is None or not math.isfinite(value):
            study.tell(trial, state=optuna.trial.TrialState.FAIL)
        else:
            study.tell(trial, value)

    def _close(self, optuna: Any, study: Any, folder: Path) -> None:
        complete = _complete(optuna, study)
        if not complete:
            return
        best = study.best_trial
        summary = {
            "objective": self.objective,
            "value": best.value,
            "overrides": _overrides(best.params),
            "folder": best.user_attrs["folder"],
            "trials": len(complete),
        }
        (folder / _BEST_FILE).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
        print(
            f"best of {len(complete)}: {self.objective} {best.value:.6g} with "
            f"{' '.join(_overrides(best.params))}",
            flush=True,
        )


def _complete(optuna: Any, study: Any) -> list[Any]:
    return list(study.get_trials(states=(optuna.trial.TrialState.COMPLETE,)))


def _overrides(params: dict[str, Any]) -> list[str]:
    return [f"{key}={value}" for key, value in params.items()]


def _distribution(optuna: Any, override: Override) -> Any:
    """Optuna's distribution of a swept override: ``interval``, ``range`` or a choice; those of
    numbers may be tagged with ``log``."""
    value, kinds = override.value(), optuna.distributions
    if isinstance(value, IntervalSweep):
        low, high = value.start, value.end
        whole = isinstance(low, int) and isinstance(high, int)
        kind = kinds.IntDistribution if whole else kinds.FloatDistribution
        return kind(low, high, log="log" in value.tags)
    if isinstance(value, RangeSweep) and not value.shuffle:
        numbers = [json.loads(text) for text in override.sweep_string_iterator()]
        return kinds.CategoricalDistribution(numbers)
    return kinds.CategoricalDistribution(list(override.sweep_string_iterator()))


def _figure(folder: Path, key: str) -> float | None:
    """A figure of a complete run, by its dotted key; None where it is not a number."""
    figures = dict(_leaves(json.loads((folder / "metrics.json").read_text(encoding="utf-8"))))
    if key not in figures:
        near = difflib.get_close_matches(key, figures, n=1, cutoff=0.0)
        raise NsmError(
            f"setting hydra.sweeper.objective: {key} is no figure of {folder}/metrics.json; "
            f"did you mean {near[0]!r}?",
            kind="unknown_option",
            key="hydra.sweeper.objective",
        )
    return figures[key]


def _leaves(node: dict[str, Any], prefix: str = "") -> Sequence[tuple[str, float | None]]:
    found: list[tuple[str, float | None]] = []
    for key, value in node.items():
        if isinstance(value, dict):
            found += _leaves(value, f"{prefix}{key}.")
        elif value is None or isinstance(value, (int, float)):
            found.append((f"{prefix}{key}", value))
    return found
