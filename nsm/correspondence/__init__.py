"""Correspondences without landmarks: proposals, their scores, and how sure they are."""

from nsm.correspondence.collection_proposal import CollectionProposal, proposed_for_all
from nsm.correspondence.proposal import Hypothesis, Proposal, proposed

__all__ = ["CollectionProposal", "Hypothesis", "Proposal", "proposed", "proposed_for_all"]
