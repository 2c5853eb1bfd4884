"""The command ``nsm``: compose the configuration, run the task, say errors in one line."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from nsm.config import checked, conf_folder, one_line, register_resolvers
from nsm.errors import NsmError


@hydra.main(config_path=str(conf_folder()), config_name="config", version_base="1.3")
def _run(config: DictConfig) -> None:
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        # training libraries take seconds to import: --help and misspelt settings need not wait
        from nsm.pipeline import run

        run(checked(config), folder)
    except BaseException:
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()  # nothing came of it: leave no empty folder behind
        raise


def main() -> None:
    """Entry point. Exit status 0, or 2 for bad input (one line on stderr), or 130 if interrupted."""
    register_resolvers()
    os.environ["HYDRA_FULL_ERROR"] = "1"  # exceptions reach us instead of being printed
    try:
        _run()
    except (HydraException, OmegaConfBaseException) as error:
        cause = error.__cause__ if isinstance(error.__cause__, NsmError) else error
        _fail(str(cause) if isinstance(cause, NsmError) else one_line(cause))
    except NsmError as error:
        _fail(str(error))
    except KeyboardInterrupt:
        sys.exit(130)


def _fail(message: str) -> None:
    print(f"nsm: {message}", file=sys.stderr)
    sys.exit(2)


if __name__ == "__main__":
    main()
