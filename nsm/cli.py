"""The command ``nsm``: compose the configuration, run the task, say errors in one line."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from nsm.arguments import Arguments
from nsm.config import checked, conf_folder, one_line, register_resolvers
from nsm.errors import NsmError, of_disk
from nsm.plugins import import_plugins
from nsm.run_directories import remove_empty
from nsm.sweeps import OUTCOMES, summary

# What is no task: `nsm WORD ...` calls main([...]) of the module, which raises NsmError for bad
# input. Imported only when called for.
COMMANDS: dict[str, str] = {"report": "nsm.commands.report", "view": "nsm.commands.view"}


def _run(config: DictConfig) -> bool:
    """Run the one job of a command that is no sweep; False if its input was bad.

    Hydra would add a line of its own to an exception.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        # training libraries take seconds to import: --help and misspelt settings need not wait
        typed = checked(config)
        if typed.resume is not None:
            _check_alone(str(typed.resume), HydraConfig.get().overrides.task)
        from nsm.pipeline import run

        run(typed, folder)
    except NsmError as error:
        _say(str(error))
        return False
    except MemoryError:
        _say("not enough memory; give a smaller mesh, network or data.batch_size")
        return False
    except OSError as error:  # a disk that is full or read-only, a folder that may not be written
        _say_of_disk(error)
        return False
    finally:
        here = Path.cwd()
        if folder != here:  # folders around it that are not within are not Hydra's, and stay
            remove_empty([folder, *(place for place in folder.parents if here in place.parents)])
    return True


def _check_alone(resume: str, words: Sequence[str]) -> None:
    """NsmError for settings beside ``resume``: they would do nothing."""
    others = [word for word in words if not word.startswith("resume=")]
    if others:
        raise NsmError(
            f"resume={resume}: a run goes on with the settings in its config.yaml; leave out "
            f"{' '.join(others)}"
        )


def main() -> None:
    """Entry point. Exit status 0; 1 if jobs of a sweep failed, 2 for bad input (one line on
    stderr), 130 if interrupted."""
    words = sys.argv[1:]
    if words and words[0] in COMMANDS:
        _command(COMMANDS[words[0]], words[1:])
    elif {"--help", "-h"} & set(words):
        _command("nsm.help", [word for word in words if not word.startswith("-")])
    elif "--version" in words:  # Hydra would tell its own
        print(f"nsm {version('nsm')}")
    else:
        _tasks()


def _command(module: str, words: list[str]) -> None:
    try:
        importlib.import_module(module).main(words)
    except NsmError as error:
        _say(str(error))
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)


def _tasks() -> None:
    register_resolvers()
    os.environ["HYDRA_FULL_ERROR"] = "1"  # exceptions reach us instead of being printed
    OUTCOMES.clear()
    good: list[bool] = []
    words = [word for word in sys.argv[1:] if not word.startswith("-")]

    @hydra.main(config_path=str(conf_folder()), config_name="config", version_base="1.3")
    def job(config: DictConfig) -> None:
        good.append(_run(config))

    try:
        _check_flags(sys.argv[1:])
        import_plugins()
        job()
    except NsmError as error:
        _say(str(error))
        sys.exit(2)
    except (HydraException, OmegaConfBaseException) as error:
        _say(one_line(error, words))
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
    except OSError as error:  # Hydra makes the run folder before anything of ours runs
        _say_of_disk(error)
        sys.exit(2)
    if not all(good):
        sys.exit(2)
    if OUTCOMES:
        _sum_up()


def _check_flags(words: Sequence[str]) -> None:
    """NsmError for flags that Hydra would answer with its usage, or with a traceback."""
    parser = Arguments(prog="nsm", add_help=False, parents=[get_args_parser()])
    given, rest = parser.parse_known_args(words)
    if rest and rest[0].startswith("-"):
        raise NsmError(f"{rest[0]}: no flag is called so; see nsm --help and nsm --hydra-help")
    if rest:
        raise NsmError(f"{rest[0]}: give flags, such as -m, before all settings")
    if given.resolve and not given.cfg:
        raise NsmError("--resolve: give it with --cfg job")
    if given.experimental_rerun is not None:
        raise NsmError("--experimental-rerun: nsm resume=FOLDER goes on with a run instead")
    modes = ("run", "multirun", "cfg", "info", "shell_completion")
    if sum(bool(getattr(given, mode)) for mode in modes) > 1:
        raise NsmError("-r, -m, --cfg, --info and -sc exclude each other; give one")


def _sum_up() -> None:
    """Say how a sweep went; exit status 1 if jobs of it failed."""
    failed = [outcome for outcome in OUTCOMES if outcome.error is not None]
    print(summary(OUTCOMES))
    for outcome in failed:
        _say(f"failed: {' '.join(outcome.words) or outcome.folder}: {outcome.error}")
    if failed:
        sys.exit(1)


def _say_of_disk(error: OSError) -> None:
    _say(f"{of_disk(error)}; choose another folder with hydra.run.dir=FOLDER, or make room")


def _say(message: str) -> None:
    """One line, whatever is in the names that it tells."""
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in message)
    print(f"nsm: {line}", file=sys.stderr)


if __name__ == "__main__":
    main()
