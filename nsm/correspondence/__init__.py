"""Correspondences without landmarks: proposals, their scores, and how sure they are; and whether
landmarks that are given fit each other."""

from nsm.correspondence.agreement import Agreement, CommonAgreement, agreement
from nsm.correspondence.coarse_check import Change, CoarseCheck, coarse_check
from nsm.correspondence.collection_proposal import CollectionProposal, proposed_for_all
from nsm.correspondence.proposal import Hypothesis, Proposal, proposed

__all__ = [
    "Agreement",
    "Change",
    "CoarseCheck",
    "CollectionProposal",
    "CommonAgreement",
    "Hypothesis",
    "Proposal",
    "agreement",
    "coarse_check",
    "proposed",
    "proposed_for_all",
]
