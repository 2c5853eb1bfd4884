"""The tasks as Lightning modules: each composes maps with energies into a loss."""

from nsm.tasks.collection_map import CollectionMap
from nsm.tasks.overfit import Overfit
from nsm.tasks.overfit_ensemble import OverfitEnsemble
from nsm.tasks.pair_map import PairMap
from nsm.tasks.param import Param
from nsm.tasks.terms import Evaluation

__all__ = ["CollectionMap", "Evaluation", "Overfit", "OverfitEnsemble", "PairMap", "Param"]
