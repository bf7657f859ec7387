"""What every head has."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["Head", "checked_range", "checked_size"]


class Head(nn.Module):
    r"""What every head has: the sizes that it asks of the predictor, and ``forward``.

    ``forward(features (*B, F), constants (C,)) -> Distribution`` with batch ``*B`` and event ``(D,)``,
    where ``F = num_features(D)`` and ``C = num_constants(D)``. The first ``D`` features move the
    distribution: adding a vector to them adds it to every draw. That is what ``residual`` predictors and
    ensembles rely on. ``constants`` may also have batch dimensions, ``(*B, C)``. A head that only
    broadcasts says so by ``stackable = True``: it is then called with features ``(N, R, F)`` and constants
    ``(N, 1, C)`` of several models at once (:func:`~torchrl_vjepa.stacking.linear`).

    A head whose mean and mode are those first ``D`` features says so by ``point_features = True``: what
    iterates the point alone then computes no others. The statement is about the ``forward`` beside it: a
    subclass with another ``forward`` makes it anew.

    A head has no parameters of its own: what it learns besides the features is its constants, of which
    the predictor keeps one row per skip.

    Examples:
        >>> from torchrl_vjepa.heads import DeltaHead
        >>> DeltaHead().num_features(4), DeltaHead().num_constants(4)
        (4, 0)
    """

    stackable = False
    point_features = False

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "forward" in cls.__dict__ and "point_features" not in cls.__dict__:
            cls.point_features = False

    def num_features(self, latent_dim: int) -> int:
        """Number of state-dependent features for a latent of ``latent_dim``.

        Args:
            latent_dim: size of the latent.

        Returns:
            The size that the predictor's trunk must have.
        """
        return latent_dim

    def num_constants(self, latent_dim: int) -> int:
        """Number of learned numbers per skip that do not depend on the state.

        Args:
            latent_dim: size of the latent.

        Returns:
            The size of each skip's row of constants.
        """
        return 0

    def init_constants(self, latent_dim: int) -> Tensor:
        """The constants that training starts from: zeros, unless the head needs others.

        Args:
            latent_dim: size of the latent.

        Returns:
            A row of shape ``(C,)``, drawn from the global random state where it is random, as the
            weights of torch's layers are.
        """
        return torch.zeros(self.num_constants(latent_dim))


def checked_range(log_var_range: tuple[float, float]) -> tuple[float, float]:
    """Refuse a range of log-variances that is empty or infinite.

    Args:
        log_var_range: ``(low, high)``, in nats.

    Returns:
        The bounds as floats.

    Raises:
        ValueError: if the range is empty or infinite.

    Examples:
        >>> checked_range((-1, 2))
        (-1.0, 2.0)
    """
    low, high = (float(bound) for bound in log_var_range)
    if not -math.inf < low < high < math.inf:
        raise ValueError(f"log_var_range must be finite (low, high) with low < high, got {log_var_range}")
    return low, high


def checked_size(name: str, value: int) -> int:
    """Refuse a size that is not positive.

    Args:
        name: of the argument, for the message.
        value: its value.

    Returns:
        The value.

    Raises:
        ValueError: if it is not positive.

    Examples:
        >>> checked_size("rank", 2)
        2
    """
    if value < 1:
        raise ValueError(f"{name} must be positive, got {value}")
    return int(value)
