"""The tasks as Lightning modules: they compose maps with energies, and nothing else."""

from nsm.tasks.overfit import Overfit

__all__ = ["Overfit"]
