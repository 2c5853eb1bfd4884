"""What L-BFGS knows of a loss's curvature: a metric, and the last steps with what they changed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor

_FLAT = 1e-10  # pairs of less curvature say nothing
# times the length that served last: a longer one is not tried first, once the iterations go on from
# an earlier step
_LONGER = 2.0
# largest change of a coefficient in the first iteration of a step without known curvature
_FIRST = 0.02

# of double precision: an array of numpy for the CPU, a tensor on any other device
Vector = Any


class LimitedMemory:
    """The two-loop recursion (Nocedal and Wright, Algorithm 7.4) from the inverse of a metric.

    Args:
        memory: pairs of steps and changes of the gradient that are kept.
        entries: of the metric's matrices; they are stored beside the pairs.
        solve: the metric's inverse times a vector.
        known: whether the metric is of the loss's own curvature.
    """

    def __init__(
        self,
        memory: int,
        entries: Sequence[Vector],
        solve: Callable[[Vector], Vector],
        known: bool,
    ) -> None:
        self.memory, self.entries, self.solve, self.known = memory, entries, solve, known
        self.pairs: list[tuple[Vector, Vector, Any]] = []  # s, y and their product
        self.scale: Any = 1.0
        self.goes_on = False  # from an earlier step
        self.length = float("inf")  # that served last, since then

    def direction(self, g: Vector) -> Vector:
        """The inverse of the approximate Hessian times a gradient."""
        q, shares = 1.0 * g, []  # a copy
        for s, y, product in reversed(self.pairs):
            shares.append((s @ q) / product)
            q -= shares[-1] * y
        d = self.scale * self.solve(q)
        for s, y, product in self.pairs:
            d += (shares.pop() - (y @ d) / product) * s
        return d

    def first(self, d: Vector, lr: float) -> float:
        """The first length to be tried along a direction."""
        if self.known or self.pairs:
            return min(lr, _LONGER * self.length)
        return min(lr, _FIRST / max(float(abs(d).max()), 1e-30))

    def learn(self, length: float, d: Vector, y: Vector) -> None:
        """Take a step, by its length along a direction, and the change of the gradient."""
        if self.goes_on:
            self.length = length
        s = length * d
        product = s @ y
        if product > _FLAT * ((s @ s) * (y @ y)) ** 0.5:
            if not self.pairs:
                self.scale = product / (y @ self.solve(y))
            self.pairs = [*self.pairs, (s, y, product)][-self.memory :]

    def forget(self) -> bool:
        """Begin again from the metric; False if nothing was learned."""
        learned = bool(self.pairs)
        self.pairs = []
        return learned

    def stored(self, tensor: Callable[[Vector], Tensor]) -> dict[str, Any]:
        """All of it but the metric's factors, for a checkpoint.

        Args:
            tensor: makes a tensor of a vector.
        """
        return {
            "entries": [tensor(entries) for entries in self.entries],
            "pairs": [(tensor(s), tensor(y)) for s, y, _ in self.pairs],
            "scale": float(self.scale),
            "length": self.length,
            "known": self.known,
        }

    def restore(self, stored: dict[str, Any], vector: Callable[[Tensor], Vector]) -> None:
        """Take the pairs of a checkpoint.

        Args:
            stored: what :meth:`stored` gave.
            vector: the inverse of its ``tensor``.
        """
        pairs = [(vector(s), vector(y)) for s, y in stored["pairs"]]
        self.pairs = [(s, y, s @ y) for s, y in pairs]
        self.scale, self.length = stored["scale"], stored["length"]
