"""The time that a search may take."""

from __future__ import annotations

import math
import time

from torch import Tensor

__all__ = ["Clock", "check_max_ms"]


def check_max_ms(max_ms: float | None) -> None:
    """Refuse what is no time.

    Args:
        max_ms: in milliseconds; ``None`` for no limit.

    Raises:
        ValueError: if it is not positive and finite.

    Examples:
        >>> check_max_ms(20.0)
    """
    if max_ms is not None and not 0 < max_ms < math.inf:
        raise ValueError(f"max_ms must be positive and finite, in milliseconds, or None, got {max_ms}")


class Clock:
    """Whether there is time for another round, if it takes as long as the longest so far.

    Args:
        max_ms: time from now on, in milliseconds; ``None`` for no limit, and then it waits for nothing.
        reserve: how many rounds' time is kept for what comes after the last.

    Examples:
        >>> import torch
        >>> Clock(None).another(torch.zeros(3))
        True
    """

    def __init__(self, max_ms: float | None, reserve: int = 0) -> None:
        self.last = 0.0 if max_ms is None else time.perf_counter()
        self.end = None if max_ms is None else self.last + 1e-3 * max_ms
        self.longest, self.reserve = 0.0, reserve

    def begin(self) -> None:
        """Rounds begin here; what was done before takes time, but is none of them."""
        if self.end is not None:
            self.last = time.perf_counter()

    def another(self, result: Tensor) -> bool:
        """Count one round, which ends when its result is there.

        Args:
            result: of the round; waited for where there is a limit.

        Returns:
            Whether there is time.
        """
        if self.end is None:
            return True
        result.sum().item()
        now = time.perf_counter()
        self.longest, self.last = max(self.longest, now - self.last), now
        return now + (1 + self.reserve) * self.longest <= self.end
