"""The tasks as Lightning modules: they compose maps with energies, and nothing else."""

from nsm.tasks.collection_map import CollectionMap
from nsm.tasks.overfit import Overfit, OverfitEnsemble
from nsm.tasks.pair_map import PairMap
from nsm.tasks.param import Param

__all__ = ["CollectionMap", "Overfit", "OverfitEnsemble", "PairMap", "Param"]
