"""Noise that is correlated along a plan."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["coloured_noise_factor"]


def coloured_noise_factor(horizon: int, beta: float) -> Tensor:
    r"""The matrix that turns white noise along a plan into noise with the power spectrum :math:`1/f^\beta`.

    :math:`L` with :math:`L L^\top = C`, where :math:`C_{kl} = c(k - l)` and

    .. math:: c(t) \propto \sum_{j=0}^{H} f_j^{-\beta} \cos(2 \pi f_j t), \qquad c(0) = 1,

    over the frequencies :math:`f_j = j / 2H`, with :math:`f_1` in the place of zero. Of twice the
    length, so that the end of a plan is not correlated with its beginning.

    Args:
        horizon: steps ``H``.
        beta: 0 is white, 1 pink, 2 brown: the larger, the longer noise keeps its sign.

    Returns:
        Lower triangular, of shape ``(H, H)``, in float64; every step has variance 1.

    Examples:
        >>> coloured_noise_factor(2, 0.0)
        tensor([[1., 0.],
                [0., 1.]], dtype=torch.float64)
    """
    frequencies = torch.arange(horizon + 1, dtype=torch.float64) / (2 * horizon)
    power = frequencies.clamp_min(1 / (2 * horizon)) ** -beta
    covariance = torch.fft.irfft(power, n=2 * horizon)[:horizon]
    covariance = covariance / covariance[0]
    lags = torch.arange(horizon)
    matrix = covariance[(lags.unsqueeze(-1) - lags).abs()]
    return torch.linalg.cholesky(matrix)
