"""A conditional normalising flow with exact density, draws and inverse."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from torchrl_vjepa.distributions.modes import maximize_log_prob
from torchrl_vjepa.distributions.noise import NoiseDistribution, SearchSpace
from torchrl_vjepa.distributions.splines import spline

__all__ = ["Coupling", "CouplingFlow"]


@dataclass(frozen=True)
class Coupling:
    r"""One coupling layer: half of the dimensions decides the spline of the other half.

    .. math:: y_a = x_a, \qquad y_b = \mathrm{spline}\big(x_b;\; W_2 \tanh(W_1 x_a + h) + w\big)

    Attributes:
        context: :math:`h`, what the condition contributes to the hidden layer, ``(*B, W)``.
        weight_in: :math:`W_1^\top`, of shape ``(D_a, W)``.
        weight_out: :math:`W_2^\top`, of shape ``(W, D_b P)`` with ``P`` parameters per spline.
        bias_out: :math:`w`, of shape ``(D_b P,)``.
        flip: whether the second half decides.

    Examples:
        >>> import torch
        >>> layer = Coupling(torch.zeros(5), torch.ones(1, 5), torch.ones(5, 23), torch.zeros(23), flip=False)
        >>> x = torch.tensor([0.3, 0.4])
        >>> y, log_slope = layer(x)
        >>> torch.allclose(layer(y, inverse=True)[0], x)
        True
    """

    context: Tensor
    weight_in: Tensor
    weight_out: Tensor
    bias_out: Tensor
    flip: bool

    def __call__(self, value: Tensor, *, inverse: bool = False) -> tuple[Tensor, Tensor]:
        """The layer, or its inverse.

        Args:
            value: of shape ``(*S, *B, D)``.
            inverse: whether to invert.

        Returns:
            The image ``(*S, *B, D)`` and the log-determinant ``(*S, *B)``.
        """
        size = self.weight_in.shape[-2]
        if self.flip:
            moved, kept = value.split([value.shape[-1] - size, size], dim=-1)
        else:
            kept, moved = value.split([size, value.shape[-1] - size], dim=-1)
        hidden = torch.tanh(_linear(kept, self.weight_in) + self.context)
        parameters = _linear(hidden, self.weight_out) + self.bias_out
        parameters = parameters.unflatten(-1, (moved.shape[-1], -1))
        moved, log_slope = spline(moved, parameters, inverse=inverse)
        kept = kept.expand(*moved.shape[:-1], -1)
        image = torch.cat([moved, kept] if self.flip else [kept, moved], dim=-1)
        return image, log_slope.sum(-1)


class CouplingFlow(NoiseDistribution):
    r"""Conditional normalising flow :math:`Z = \mu + \sigma \odot s^{-1}(c^{-1}(\epsilon))`.

    An elementwise spline :math:`s` shapes every dimension, coupling layers :math:`c` tie them together
    (neural spline flow, Durkan et al., 2019). Density, draws and inverse are exact and cost the same.

    Mean, variance and covariance have no closed form: they are averages over a fixed Latin
    hypercube of noise, in pairs :math:`\pm \epsilon` and with unit covariance. They are the
    same every time, have gradients, and are exact while the flow is affine.

    Args:
        loc: :math:`\mu`, of shape ``(*B, D)``: moves the distribution.
        scale: :math:`\sigma`, positive, broadcastable to ``(*B, D)``.
        elementwise: parameters of :math:`s`, ``(*B, D, P)``.
        couplings: the layers of :math:`c`, in the order from latent to noise.
        num_points: how many points the moments average over.

    Raises:
        ValueError: if ``num_points`` is not positive.

    Examples:
        >>> import torch
        >>> p = CouplingFlow(torch.ones(5, 2), torch.full((2,), 0.5), torch.zeros(5, 2, 23), ())
        >>> p.mean[0].round(decimals=3), p.variance[0]  # zero parameters are the identity
        (tensor([1., 1.]), tensor([0.2500, 0.2500]))
        >>> z = p.from_noise(torch.full((2,), 0.3))
        >>> torch.allclose(p.to_noise(z)[0], torch.full((5, 2), 0.3))
        True
    """

    def __init__(
        self,
        loc: Tensor,
        scale: Tensor,
        elementwise: Tensor,
        couplings: Sequence[Coupling],
        *,
        num_points: int = 64,
    ) -> None:
        if num_points < 1:
            raise ValueError(f"num_points must be positive, got {num_points}")
        dtype = torch.promote_types(loc.dtype, scale.dtype)
        batch = torch.broadcast_shapes(loc.shape[:-1], scale.shape[:-1])
        self.loc = loc.to(dtype).expand(*batch, loc.shape[-1])
        self.scale = scale.to(dtype)
        self.elementwise = elementwise
        self.couplings = tuple(couplings)
        self.num_points = num_points
        super().__init__(batch, loc.shape[-1], loc.shape[-1], self.loc)

    @property
    def mean(self) -> Tensor:
        """Average of the fixed points, ``(*B, D)``."""
        return self.loc + self._deviations().mean(0)

    @property
    def variance(self) -> Tensor:
        """Variance of the fixed points, ``(*B, D)``."""
        points = self._deviations()
        return (points - points.mean(0)).square().mean(0)

    @property
    def covariance_matrix(self) -> Tensor:
        """Covariance of the fixed points, ``(*B, D, D)``."""
        points = self._deviations()
        centred = (points - points.mean(0)).movedim(0, -1)
        return centred @ centred.mT / points.shape[0]

    @property
    def mode(self) -> Tensor:
        """The most probable point (MAP), ``(*B, D)``: gradient ascent in the space of the noise.

        Its gradient is that of the transform at fixed noise.
        """
        with torch.no_grad():
            noise, _ = self.to_noise(maximize_log_prob(self, num_steps=50)[0])
        return self.from_noise(noise)

    def to_noise(self, value: Tensor) -> tuple[Tensor, Tensor]:
        r"""The inverse, :math:`\epsilon = T^{-1}(Z)`.

        Args:
            value: of shape ``(*S, *B, D)``.

        Returns:
            Noise ``(*S, *B, D)`` and :math:`\log |\det \partial_Z T^{-1}|` of shape ``(*S, *B)``.
        """
        normed = (value - self.loc) / self.scale
        noise, log_slope = spline(normed, self.elementwise)
        log_det = (log_slope - self.scale.log()).sum(-1)
        for layer in self.couplings:
            noise, change = layer(noise)
            log_det = log_det + change
        return noise, log_det

    def from_noise(self, noise: Tensor) -> Tensor:
        """Draws, with gradients.

        Args:
            noise: of shape ``(*S, *B, D)``, or broadcastable to it.

        Returns:
            Latents of shape ``(*S, *B, D)``.
        """
        return self.loc + self._deviation(noise)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density, in nats.

        Args:
            value: of shape ``(*S, *B, D)``.

        Returns:
            ``(*S, *B)``.
        """
        noise, log_det = self.to_noise(value)
        return log_det - 0.5 * (noise.square().sum(-1) + noise.shape[-1] * math.log(2 * math.pi))

    def search_space(self) -> SearchSpace:
        """Starts at the four most probable of 65 fixed points, in the space of the noise.

        Returns:
            Starts ``(4, *B, D)`` and the transform, from noise to latents.
        """
        points = normal_points(64, self.event_shape[0]).to(self.loc)
        points = torch.cat([torch.zeros_like(points[:1]), points])
        points = points.reshape(-1, *[1] * len(self.batch_shape), self.event_shape[0])
        points = points.expand(-1, *self.batch_shape, -1)
        with torch.no_grad():
            best = self.log_prob(self.from_noise(points)).topk(4, dim=0).indices
        starts = torch.take_along_dim(points, best.unsqueeze(-1), 0)
        return starts, self.from_noise, torch.ones_like(self.loc)

    def expand(self, batch_shape: Sequence[int], _instance: Distribution | None = None) -> CouplingFlow:
        """The same flow, broadcast to ``batch_shape``.

        Args:
            batch_shape: the new batch shape.

        Returns:
            The expanded distribution.
        """
        loc = self.loc.expand(*batch_shape, -1)
        return CouplingFlow(loc, self.scale, self.elementwise, self.couplings, num_points=self.num_points)

    def _deviation(self, noise: Tensor) -> Tensor:
        """Draws without the location, whose digits they would lose beside a large one."""
        for layer in reversed(self.couplings):
            noise, _ = layer(noise, inverse=True)
        return self.scale * spline(noise, self.elementwise, inverse=True)[0]

    def _deviations(self) -> Tensor:
        """Of the fixed points, ``(P, *B, D)``."""
        points = normal_points(self.num_points, self.event_shape[0]).to(self.loc)
        noise = points.reshape(-1, *[1] * len(self.batch_shape), self.event_shape[0])
        return self._deviation(noise).expand(-1, *self.batch_shape, -1)


@lru_cache(maxsize=32)
def normal_points(num: int, dim: int) -> Tensor:
    """Fixed points that represent a standard normal: mean zero and unit covariance, exactly.

    Args:
        num: how many at least; rounded up to an even number above ``2 * dim``.
        dim: number of dimensions.

    Returns:
        Points of shape ``(num, dim)``, in float64.
    """
    half = max((num + 1) // 2, dim + 1)
    # A Latin hypercube of numpy's: torch's generators are batched under vmap, where this may be called.
    cells = np.random.default_rng(0).permuted(np.tile(np.arange(half), (dim, 1)), axis=1).T
    with torch.inference_mode(False):  # what is cached must also do for training
        points = torch.special.ndtri(torch.from_numpy((cells + 0.5) / half))
        points = torch.cat([points, -points])
        factor = torch.linalg.cholesky(points.mT @ points / len(points))
        return torch.linalg.solve_triangular(factor, points.mT, upper=False).mT


def _linear(value: Tensor, weight: Tensor) -> Tensor:
    """Weights may have batch dimensions of their own (members of an ensemble)."""
    if weight.ndim == 2:
        return value @ weight
    return (value.unsqueeze(-2) @ weight).squeeze(-2)
