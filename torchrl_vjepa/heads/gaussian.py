"""The point and the Gaussians."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.distributions import Independent, MultivariateNormal

from torchrl_vjepa.distributions import (
    Delta,
    LowRankGaussian,
    diag_gaussian,
    full_gaussian,
    soft_clamp,
)
from torchrl_vjepa.heads.base import Head, checked_range, checked_size
from torchrl_vjepa.stacking import halves

__all__ = ["DeltaHead", "DiagGaussianHead", "FullGaussianHead", "LowRankGaussianHead"]

#: Correlations are bounded: no dimension is predicted from the others to less than 1 / (1 + 10^2) of its
#: variance, so factors stay well conditioned.
MAX_LOADING = 10.0


class DeltaHead(Head):
    r"""Deterministic head: :math:`p_\phi(Z_T \mid Z_C, \xi) = \delta(Z_T - g_\phi(Z_C, \xi))`.

    The deterministic JEPA of ``eq:context_predictor``.

    Examples:
        >>> import torch
        >>> DeltaHead()(torch.ones(2, 3), torch.empty(0)).mean.shape
        torch.Size([2, 3])
    """

    stackable = True
    point_features = True

    def forward(self, features: Tensor, constants: Tensor) -> Delta:
        """Point mass on the features.

        Args:
            features: the prediction, of shape ``(*B, D)``.
            constants: not used by this head; of shape ``(0,)``.

        Returns:
            The point mass.
        """
        return Delta(features)


class DiagGaussianHead(Head):
    r"""Diagonal Gaussian head (``eq:vjepa_predictive_model``).

    :math:`p_\phi(Z_T \mid Z_C, \xi) = \mathcal N(\mu_\phi, \mathrm{diag}(\sigma_\phi^2))`, with the
    log-variance softly clamped to ``log_var_range``.

    Args:
        scale: ``"state"``: :math:`\log \sigma^2_\phi(Z_C)` is a second output of the trunk, as in the
            paper; ``"constant"``: one learned log-variance per skip and dimension, which is exact for
            linear-Gaussian systems.
        log_var_range: ``(low, high)`` of the log-variance, in nats; ``None`` leaves it unbounded, as the
            paper prints it.

    Raises:
        ValueError: if ``scale`` is unknown or the range is empty or infinite.

    Examples:
        >>> import torch
        >>> head = DiagGaussianHead()
        >>> p = head(torch.zeros(5, head.num_features(3)), torch.empty(0))
        >>> p.batch_shape, p.event_shape, p.variance[0]
        (torch.Size([5]), torch.Size([3]), tensor([1., 1., 1.]))
    """

    stackable = True
    point_features = True

    def __init__(
        self,
        scale: Literal["state", "constant"] = "state",
        *,
        log_var_range: tuple[float, float] | None = (-16.0, 16.0),
    ) -> None:
        super().__init__()
        if scale not in ("state", "constant"):
            raise ValueError(f"scale must be 'state' or 'constant', got {scale!r}")
        self.scale = scale
        self.log_var_range = None if log_var_range is None else checked_range(log_var_range)

    def num_features(self, latent_dim: int) -> int:
        """Mean and, for ``scale="state"``, log-variance.

        Args:
            latent_dim: size of the latent.

        Returns:
            ``2 D`` or ``D``.
        """
        return 2 * latent_dim if self.scale == "state" else latent_dim

    def num_constants(self, latent_dim: int) -> int:
        """The log-variances for ``scale="constant"``.

        Args:
            latent_dim: size of the latent.

        Returns:
            ``0`` or ``D``.
        """
        return 0 if self.scale == "state" else latent_dim

    def forward(self, features: Tensor, constants: Tensor) -> Independent:
        """The Gaussian.

        Args:
            features: mean, or mean and log-variance, of shape ``(*B, D)`` or ``(*B, 2 D)``.
            constants: log-variance of shape ``(D,)``, or empty.

        Returns:
            Diagonal Gaussian with batch ``*B`` and event ``(D,)``.
        """
        if self.scale == "state":
            loc, log_var = halves(features)
        else:
            loc, log_var = features, constants
        return diag_gaussian(loc, log_var=log_var, log_var_range=self.log_var_range)


class _CorrelatedHead(Head):
    """A Gaussian with marginal log-variances and loadings that correlate its dimensions.

    Mean, log-variances and loadings; the latter two are the sum of a feature (``scale="state"``) and a
    constant.
    """

    def __init__(
        self,
        scale: Literal["state", "constant"],
        log_var_range: tuple[float, float],
    ) -> None:
        super().__init__()
        if scale not in ("state", "constant"):
            raise ValueError(f"scale must be 'state' or 'constant', got {scale!r}")
        self.scale = scale
        self.log_var_range = checked_range(log_var_range)

    def num_features(self, latent_dim: int) -> int:
        """The mean and, for ``scale="state"``, what the constants hold too.

        Args:
            latent_dim: size of the latent.

        Returns:
            The size that the predictor's trunk must have.
        """
        return latent_dim + (self.num_constants(latent_dim) if self.scale == "state" else 0)

    def num_constants(self, latent_dim: int) -> int:
        """Log-variances and loadings.

        Args:
            latent_dim: size of the latent.

        Returns:
            The size of each skip's row of constants.
        """
        return latent_dim + self._num_loadings(latent_dim)

    def _num_loadings(self, latent_dim: int) -> int:
        raise NotImplementedError

    def _split(self, features: Tensor, constants: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean ``(*B, D)``, standard deviation ``(*B, D)`` and loadings ``(*B, L)``."""
        num = constants.shape[-1]
        if self.scale == "state":
            size = features.shape[-1] - num
            features, own = features.split([size, num], dim=-1)
            constants = own + constants
        dim = features.shape[-1]
        log_var, loadings = constants.split([dim, num - dim], dim=-1)
        return features, (0.5 * soft_clamp(log_var, *self.log_var_range)).exp(), loadings


def _bounded_rows(loadings: Tensor) -> tuple[Tensor, Tensor]:
    """Rows ``(*B, D, R)`` with bounded norms over the norms of ``(row, 1)``, and one over those."""
    squared = loadings.square().sum(-1, keepdim=True)
    bounded = loadings * (1 + squared / MAX_LOADING**2).rsqrt()
    norm = (1 + bounded.square().sum(-1, keepdim=True)).sqrt()
    return bounded / norm, (1 / norm).squeeze(-1)


class FullGaussianHead(_CorrelatedHead):
    r"""Gaussian head with a full covariance.

    :math:`p_\phi(Z_T \mid Z_C, \xi) = \mathcal N(\mu, L L^\top)`. Row :math:`d` of :math:`L` is
    :math:`\sigma_d\, (v_{d1}, \dots, v_{d,d-1}, 1)` over the norm of its bracket: :math:`\sigma_d^2` is the
    marginal variance whatever the correlations are, and zero loadings :math:`v` are
    :class:`DiagGaussianHead`. Loadings are softly bounded (:data:`MAX_LOADING`).

    For errors that go together in pairs of dimensions; :math:`O(D^2)` features.

    Args:
        scale: ``"state"``: log-variances and loadings are a feature plus a learned constant;
            ``"constant"``: the constant alone, exact for linear-Gaussian systems.
        log_var_range: ``(low, high)`` of the marginal log-variance, in nats.

    Raises:
        ValueError: if ``scale`` is unknown or the range is empty or infinite.

    Examples:
        >>> import torch
        >>> head = FullGaussianHead("constant")
        >>> p = head(torch.zeros(5, 2), torch.tensor([0.0, 0.0, 1.0]))
        >>> p.covariance_matrix[0]
        tensor([[1.0000, 0.7053],
                [0.7053, 1.0000]])
    """

    point_features = True

    def __init__(
        self,
        scale: Literal["state", "constant"] = "state",
        *,
        log_var_range: tuple[float, float] = (-16.0, 16.0),
    ) -> None:
        super().__init__(scale, log_var_range)

    def _num_loadings(self, latent_dim: int) -> int:
        return latent_dim * (latent_dim - 1) // 2

    def forward(self, features: Tensor, constants: Tensor) -> MultivariateNormal:
        """The Gaussian.

        Args:
            features: mean and, for ``scale="state"``, log-variances and loadings, ``(*B, F)``.
            constants: log-variances and loadings, of shape ``(C,)``.

        Returns:
            Gaussian with batch ``*B`` and event ``(D,)``.
        """
        loc, std, loadings = self._split(features, constants)
        dim = loc.shape[-1]
        # Loading (d, i < d) is number d (d - 1) / 2 + i; the last one is the zero of the upper triangle.
        column = torch.arange(dim, device=loc.device)
        row = column.unsqueeze(-1)
        index = torch.where(column < row, row * (row - 1) // 2 + column, loadings.shape[-1])
        padded = torch.cat([loadings, torch.zeros_like(std[..., :1])], dim=-1)
        rows, diagonal = _bounded_rows(padded[..., index])
        return full_gaussian(loc, std.unsqueeze(-1) * (rows + torch.diag_embed(diagonal)))


class LowRankGaussianHead(_CorrelatedHead):
    r"""Gaussian head whose dimensions share a few common causes.

    :math:`p_\phi(Z_T \mid Z_C, \xi) = \mathcal N(\mu, W W^\top + \mathrm{diag}(\psi^2))` with
    :math:`R` columns in :math:`W`. Row :math:`d` of :math:`(W, \psi)` is
    :math:`\sigma_d\, (v_{d1}, \dots, v_{dR}, 1)` over the norm of its bracket: :math:`\sigma_d^2` is the
    marginal variance. Loadings are softly bounded (:data:`MAX_LOADING`).

    For large latents: :math:`O(D R)` features, :math:`O(D R^2)` time.

    Args:
        rank: :math:`R`.
        scale: see :class:`FullGaussianHead`.
        log_var_range: ``(low, high)`` of the marginal log-variance, in nats.

    Raises:
        ValueError: if ``rank`` is not positive, ``scale`` is unknown, or the range is empty or infinite.

    Examples:
        >>> import torch
        >>> head = LowRankGaussianHead(rank=1)
        >>> p = head(torch.zeros(5, head.num_features(3)), head.init_constants(3))
        >>> p.batch_shape, p.variance[0]
        (torch.Size([5]), tensor([1.0000, 1.0000, 1.0000]))
    """

    point_features = True

    def __init__(
        self,
        rank: int = 2,
        scale: Literal["state", "constant"] = "state",
        *,
        log_var_range: tuple[float, float] = (-16.0, 16.0),
    ) -> None:
        super().__init__(scale, log_var_range)
        self.rank = checked_size("rank", rank)

    def _num_loadings(self, latent_dim: int) -> int:
        return latent_dim * self.rank

    def init_constants(self, latent_dim: int) -> Tensor:
        """Unit variances and small random loadings: at zero their gradient vanishes.

        Args:
            latent_dim: size of the latent.

        Returns:
            A row of shape ``(C,)``.
        """
        return torch.cat([torch.zeros(latent_dim), 0.1 * torch.randn(latent_dim * self.rank)])

    def forward(self, features: Tensor, constants: Tensor) -> LowRankGaussian:
        """The Gaussian.

        Args:
            features: mean and, for ``scale="state"``, log-variances and loadings, ``(*B, F)``.
            constants: log-variances and loadings, of shape ``(C,)``.

        Returns:
            Gaussian with batch ``*B`` and event ``(D,)``.
        """
        loc, std, loadings = self._split(features, constants)
        rows, rest = _bounded_rows(loadings.unflatten(-1, (loc.shape[-1], self.rank)))
        return LowRankGaussian(loc, std.unsqueeze(-1) * rows, std * rest)
