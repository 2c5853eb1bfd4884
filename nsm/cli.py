"""The command ``nsm``: compose the configuration, run the task, answer errors in one line."""

from __future__ import annotations

import importlib
import os
import sys
import sysconfig
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

from nsm.arguments import Arguments
from nsm.command_line import prepared_overrides, with_task
from nsm.config import conf_folder, read_config, register, setting_error
from nsm.errors import NsmError, of_disk
from nsm.loading_libraries import loading_libraries
from nsm.plugins import import_here, import_plugins
from nsm.run_directories import remove_empty
from nsm.stages import stage
from nsm.sweeps import OUTCOMES, summary

# What is no task: `nsm WORD ...` calls main([...]) of the module, which raises NsmError for bad
# input. Imported only when called for.
COMMANDS: dict[str, str] = {
    "landmarks": "nsm.commands.landmarks",
    "report": "nsm.commands.report",
    "view": "nsm.commands.view",
}
BRIEF = """\
nsm: neural surface maps

  nsm mine.obj                       a neural surface of a mesh
  nsm pair_map a.obj b.obj           a map between two surfaces
  nsm collection_map a b c           maps among three or more
  nsm param mine.obj                 flatten
  nsm landmarks a.obj b.obj          place landmarks in the browser
  nsm view FOLDER                    show a run in the browser
  nsm report FOLDER...               compare runs

A mesh is an OBJ, PLY, OFF, STL, GLTF or GLB file, or a model of the catalogue: nsm --help surface.
Add settings, as in device=cuda experiment=quick; nsm --help lists them."""
# Hydra's documented flags, and whether each has a value
_HYDRA_FLAGS: dict[tuple[str, ...], dict[str, Any]] = {
    ("--hydra-help",): {"action": "store_true"},
    ("--cfg", "-c"): {"choices": ["job", "hydra", "all"]},
    ("--resolve",): {"action": "store_true"},
    ("--package", "-p"): {},
    ("--run", "-r"): {"action": "store_true"},
    ("--multirun", "-m"): {"action": "store_true"},
    ("--shell-completion", "-sc"): {"action": "store_true"},
    ("--config-path", "-cp"): {},
    ("--config-name", "-cn"): {},
    ("--config-dir", "-cd"): {},
    ("--info", "-i"): {
        "nargs": "?",
        "const": "all",
        "choices": ["all", "config", "defaults", "defaults-tree", "plugins", "searchpath"],
    },
}
_MODES = ("run", "multirun", "cfg", "info", "shell_completion")


def main() -> None:
    """Entry point. Exit status 0; 1 if jobs of a sweep failed or a defect showed, 2 for bad input
    (one line on stderr), 130 if interrupted."""
    arguments = sys.argv[1:]
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    try:
        import_here()
        status = _main(arguments)
    except KeyboardInterrupt as stop:
        status = 130
        if not stop.args and not COMMANDS.keys() & set(arguments[:1]):  # Ctrl-C ends a viewer
            _say("interrupted")
    except Exception as error:
        if debug:
            traceback.print_exception(error)
        status = _answer(error)
    if status:
        sys.exit(status)


def _main(arguments: list[str]) -> int:
    if not arguments:
        print(BRIEF)
    elif arguments[0] in COMMANDS:
        importlib.import_module(COMMANDS[arguments[0]]).main(arguments[1:])
    elif {"--help", "-h"} & set(arguments):
        from nsm.help import main

        parser = Arguments(prog="nsm", add_help=False, allow_abbrev=False)
        parser.add_argument("--config-dir", "-cd", type=Path)
        given, rest = parser.parse_known_args(arguments)
        main([word for word in rest if not word.startswith("-")], given.config_dir)
    elif "--version" in arguments:  # Hydra would print its own
        print(f"nsm {version('nsm')}")
    else:
        return _run_tasks(_hydra_arguments(arguments))
    return 0


def _hydra_arguments(arguments: Sequence[str]) -> list[str]:
    """A command line as Hydra takes it: flags first, and mesh files as settings.

    Raises:
        NsmError: a flag that does not exist, or flags that exclude each other.
    """
    parser = Arguments(prog="nsm", add_help=False, allow_abbrev=False)
    for names, options in _HYDRA_FLAGS.items():
        parser.add_argument(*names, **options)
    parser.add_argument("overrides", nargs="*")
    given, unknown = parser.parse_known_intermixed_args(arguments)
    if unknown:
        raise NsmError(
            f"{unknown[0]}: no such flag; see nsm --help and nsm --hydra-help",
            kind="unknown_flag",
            key=unknown[0],
        )
    if given.resolve and not given.cfg:
        raise NsmError("--resolve: give it with --cfg job", kind="unknown_flag", key="--resolve")
    if sum(bool(getattr(given, mode)) for mode in _MODES) > 1:
        raise NsmError(
            "-r, -m, --cfg, --info and -sc exclude each other; give one",
            kind="conflicting_flags",
        )
    flags = []
    for name, *_ in _HYDRA_FLAGS:
        value = getattr(given, name.strip("-").replace("-", "_"))
        flags += [name] if value is True else [name, value] if value else []
    if given.shell_completion:  # its overrides are query=bash, install=bash
        return [*flags, *given.overrides]
    return [*flags, *prepared_overrides(with_task(given.overrides))]


def _run_tasks(arguments: list[str]) -> int:
    register()
    import_plugins()
    OUTCOMES.clear()
    # Hydra would print what it composes, without the defaults of classes and functions
    shown = arguments[:2] == ["--cfg", "job"] and "--package" not in arguments
    if shown:
        arguments = [word for word in arguments[2:] if word != "--resolve"]

    failures: list[Exception] = []

    @hydra.main(config_path=str(conf_folder()), config_name="config", version_base="1.3")
    def job(config: DictConfig) -> None:
        try:
            _run(config, shown=shown)
        except Exception as error:  # Hydra would print a line of its own about it
            failures.append(error)

    with _process_of_hydra(arguments):
        job()
    if failures:
        raise failures[0]
    return _sum_up() if OUTCOMES else 0


@contextmanager
def _process_of_hydra(arguments: list[str]) -> Iterator[None]:
    """Give Hydra its command line, and let exceptions through instead of printing them."""
    before = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    sys.argv = [sys.argv[0], *arguments]
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        yield
    finally:
        sys.argv = before[0]
        if before[1] is None:
            del os.environ["HYDRA_FULL_ERROR"]
        else:
            os.environ["HYDRA_FULL_ERROR"] = before[1]


def _run(config: DictConfig, *, shown: bool = False) -> None:
    """Run the one job of a command that is no sweep, or show its settings alone."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    overrides = list(HydraConfig.get().overrides.task)
    try:
        # training libraries take seconds to import: --help and misspelt settings need not wait
        console = Console(highlight=False, markup=False, stderr=shown)
        with stage(console, "loading libraries"), loading_libraries(frozen=True):
            from nsm.config_validation import checked
            from nsm.pipeline import run

            complete = checked(config, overrides)
        if shown:
            print(OmegaConf.to_yaml(complete, resolve=True), end="")
            return
        if complete.resume is not None:
            _check_alone(str(complete.resume), overrides)

        run(complete, folder)
    finally:
        here = Path.cwd()
        if folder != here:  # folders around it that are not within are not Hydra's, and stay
            remove_empty([folder, *(place for place in folder.parents if here in place.parents)])


def _check_alone(resume: str, overrides: Sequence[str]) -> None:
    """NsmError for settings beside ``resume``, which would have no effect."""
    others = [word for word in overrides if not word.startswith(("resume=", "trust="))]
    if others:
        raise NsmError(
            f"resume={resume}: a run continues with the settings in its config.yaml; omit "
            f"{' '.join(others)}",
            kind="conflicting_settings",
            key="resume",
        )


def _sum_up() -> int:
    """Compare the jobs of a sweep, and print how it went; exit status 1 if jobs of it failed."""
    failed = [outcome for outcome in OUTCOMES if outcome.error is not None]
    complete = [outcome.folder for outcome in OUTCOMES if outcome.error is None]
    if len(complete) > 1:
        _compare(complete)
    print(summary(OUTCOMES))
    for outcome in failed:
        _say(f"failed: {' '.join(outcome.overrides) or outcome.folder}: {outcome.error}")
    return 1 if failed else 0


def _compare(folders: Sequence[Path]) -> None:
    """Leave the figure and the table of a sweep's jobs in its folder, and print the table."""
    console = Console(highlight=False, markup=False)
    with stage(console, "figure of the sweep"):
        from nsm.results.render import axis_of, upright
        from nsm.results.report.sweep import write_sweep

        config = read_config(folders[0] / "config.yaml")
        with upright(axis_of(config)):
            table = write_sweep(folders[0].parent, figure=bool(config.get("artefacts", True)))
    if table is not None:
        console.print(table)


def _answer(error: Exception) -> int:
    """Print an exception in one line; give the exit status."""
    raised = traceback.extract_tb(error.__traceback__)[-1].filename
    of_hydra = isinstance(error, ValueError) and raised.startswith(str(Path(hydra.__file__).parent))
    if of_hydra or isinstance(error, (HydraException, OmegaConfBaseException)):
        error = setting_error(error)
    elif isinstance(error, MemoryError):
        error = NsmError("not enough memory; give a smaller mesh, network or data.batch_size")
    elif isinstance(error, OSError):  # a full or read-only disk, a folder without permission
        error = NsmError(
            f"{of_disk(error)}; choose another folder with hydra.run.dir=FOLDER, or make room"
        )
    place = _place(error)
    if isinstance(error, NsmError):
        _say(f"{error} ({place}; nsm --debug shows the traceback)" if place else str(error))
        return 2
    reason = " ".join(str(error).split())[:300]
    where = f" ({place})" if place else ""
    _say(f"{type(error).__name__}: {reason}{where}; nsm --debug shows the traceback")
    return 1


def _place(error: BaseException) -> str:
    """The last line of the user's own code that an exception passed through, as FILE:LINE.

    Of an exception that passed through none, the last line of nsm's, unless it is an answer to
    bad input.
    """
    package = Path(__file__).parent
    ours = (str(package), str(package.parent / "hydra_plugins"))
    libraries = [sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib", "purelib")]
    chain, own = [], ""
    link: BaseException | None = error
    while link is not None and link not in chain:
        chain.append(link)
        for frame in traceback.extract_tb(link.__traceback__):
            place = f"{frame.filename}:{frame.lineno}"
            if frame.filename.startswith(ours):
                own = place
            elif frame.filename.startswith((*libraries, "<", sys.prefix)):
                continue
            elif os.path.isfile(frame.filename):  # not of a library in C, which calls ours
                return place
        link = link.__cause__ or link.__context__
    return "" if isinstance(error, NsmError) else own


def _say(message: str) -> None:
    """Print one line, whatever is in the names within it."""
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in message)
    print(f"nsm: {line}", file=sys.stderr)


if __name__ == "__main__":
    main()
