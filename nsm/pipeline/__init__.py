"""From a checked configuration to a run folder with results."""

from nsm.pipeline.process_state import process_state, quiet_lightning
from nsm.pipeline.runner import built, make_task, run, run_task
from nsm.pipeline.task import Given, Task

__all__ = [
    "Given",
    "Task",
    "built",
    "make_task",
    "process_state",
    "quiet_lightning",
    "run",
    "run_task",
]
