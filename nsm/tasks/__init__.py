"""The tasks as Lightning modules: they compose maps with energies, and nothing else."""

from nsm.tasks.overfit import Overfit
from nsm.tasks.param import Param

__all__ = ["Overfit", "Param"]
