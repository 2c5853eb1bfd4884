"""Correspondences without landmarks: proposals, their scores, and how sure they are."""

from nsm.correspondence.proposal import Hypothesis, Proposal, proposed

__all__ = ["Hypothesis", "Proposal", "proposed"]
