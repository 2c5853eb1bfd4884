"""Which hypothesis of each member of a collection is taken, decided for all members together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

Choice = dict[int, int]  # of each member the number of its hypothesis


@dataclass(frozen=True)
class Way:
    """A choice for all members.

    Attributes:
        choice: of each member the number of its hypothesis.
        total: the members' own scores, and those of all two members together.
        behind: by how much the total is above the least one, for each member that takes another
            hypothesis than there. So maps that a symmetry exchanges on all members at once are as
            nearly tied as they are on one.
        turned: the member, and its hypothesis, for which this is the best choice.
    """

    choice: Choice
    total: float
    behind: float
    turned: tuple[int, int]


def ways(own: Mapping[int, np.ndarray], between: Mapping[tuple[int, int], np.ndarray]) -> list[Way]:
    """The choice of least total, then for each other hypothesis of each member the best choice
    that takes it, those least behind first.

    Totals are lowered by changing one member at a time, from what goes best with the hypothesis.

    Args:
        own: of each member the scores (H,) of its hypotheses.
        between: of two members (i, j) the scores (H, H') of theirs together.
    """
    members = list(own)
    member = np.repeat(np.arange(len(members)), [len(own[i]) for i in members])
    number = np.concatenate([np.arange(len(own[i])) for i in members])
    alone = np.concatenate([own[i] for i in members])
    together = np.zeros((len(alone), len(alone)))
    for (i, j), scores in between.items():
        block = np.ix_(member == members.index(i), member == members.index(j))
        together[block], together.T[block] = scores, scores

    found = [_settled(k, member, alone, together) for k in range(len(alone))]
    totals = np.array([alone[c].sum() + together[np.ix_(c, c)].sum() / 2 for c in found])
    least = found[int(totals.argmin())]

    def way(k: int) -> Way:
        rise = float(totals[k] - totals.min())
        changed = max(int((found[k] != least).sum()), 1)
        choice = dict(zip(members, number[found[k]].tolist(), strict=True))
        turned = members[member[k]], int(number[k])
        return Way(choice, float(totals[k]), rise / changed, turned)

    others = [way(k) for k in range(len(alone)) if k not in least]
    return [way(int(totals.argmin())), *sorted(others, key=lambda one: one.behind)]


def _settled(
    pinned: int, member: np.ndarray, alone: np.ndarray, together: np.ndarray
) -> np.ndarray:
    """The choice, of each member a number (M,) among all hypotheses, that no change of one member
    but that of the pinned hypothesis betters."""
    count = int(member.max()) + 1
    # the weight that all others will have together, of which one is known
    first = alone + max(count - 1, 1) * together[pinned]
    chosen = np.array([int(np.where(member == i, first, np.inf).argmin()) for i in range(count)])
    chosen[member[pinned]] = pinned
    while True:
        cost = alone + together[:, chosen].sum(axis=1)
        gain = cost[chosen][member] - cost
        gain[member == member[pinned]] = 0.0
        best = int(gain.argmax())
        if gain[best] < 1e-9:
            return chosen
        chosen[member[best]] = best
