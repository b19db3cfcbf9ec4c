"""Results of a slow participant on their way: each counts from its own time on, in the order of their making."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class Mailbox(Generic[T]):
    """What the lockstep does with gated topics: a step delivers everything that is due by its stamp."""

    def __init__(self) -> None:
        self._coming: deque[tuple[int, T]] = deque()

    def post(self, due: int, item: T) -> None:
        """A result that counts from the step at or after `due` [ns]."""
        self._coming.append((due, item))

    def released(self, stamp: int) -> list[T]:
        """What is due at the step `stamp` [ns]; later results wait behind earlier ones."""
        out = []
        while self._coming and self._coming[0][0] <= stamp:
            out.append(self._coming.popleft()[1])
        return out
