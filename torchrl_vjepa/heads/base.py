"""What every head has, and the soft clamp that keeps its variances in range."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

__all__ = ["Head", "checked_range", "checked_size", "soft_clamp"]


def soft_clamp(value: Tensor, low: float, high: float) -> Tensor:
    r"""Clamp with a gradient everywhere.

    The identity up to a margin :math:`m` from the bounds (1, or a quarter of a narrow range); beyond it,
    the excess :math:`e` becomes :math:`m e / (m + |e|)`, which approaches the bound. (Softplus would do
    the same at several times the cost.)

    Args:
        value: any tensor.
        low: lower bound, approached and never passed.
        high: upper bound, approached and never passed.

    Returns:
        A tensor of the same shape with values in ``[low, high]``.

    Examples:
        >>> import torch
        >>> soft_clamp(torch.tensor([-1000.0, 1.5, 1000.0]), -10.0, 10.0).round(decimals=2)
        tensor([-10.0000,   1.5000,  10.0000])
    """
    margin = min(1.0, (high - low) / 4)
    inside = value.clamp(low + margin, high - margin)
    excess = value - inside
    # Not m e / (m + |e|): infinity over infinity.
    return inside + excess.sign() * (margin - margin**2 / (margin + excess.abs()))


class Head(nn.Module):
    r"""What every head has: the sizes that it asks of the predictor, and ``forward``.

    ``forward(features (*B, F), constants (C,)) -> Distribution`` with batch ``*B`` and event ``(D,)``,
    where ``F = num_features(D)`` and ``C = num_constants(D)``. The first ``D`` features move the
    distribution: adding a vector to them adds it to every draw. That is what ``residual`` predictors and
    ensembles rely on. ``constants`` may also have batch dimensions, ``(*B, C)``.

    A head has no parameters of its own: what it learns besides the features is its constants, of which
    the predictor keeps one row per skip.

    Examples:
        >>> from torchrl_vjepa.heads import DeltaHead
        >>> DeltaHead().num_features(4), DeltaHead().num_constants(4)
        (4, 0)
    """

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
