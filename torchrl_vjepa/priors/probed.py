"""Goals that are no observations: a prior in a probed coordinate, pulled back to the latent."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.distributions import (
    Distribution,
    Independent,
    LowRankMultivariateNormal,
    MultivariateNormal,
    Normal,
)

from torchrl_vjepa.distributions import Density, GaussianFactor, LowRankGaussian, full_gaussian
from torchrl_vjepa.priors.arguments import affine_map
from torchrl_vjepa.priors.base import LatentDensity, Prior, Task, check_density

__all__ = ["ProbedPrior"]


class ProbedPrior(Prior):
    r"""A prior in the coordinate :math:`y = W Z + b` of a linear probe, as one of latents.

    .. math::
        p(Z \mid \eta) = p_y(W Z + b \mid \eta)\, \sqrt{\det W W^\top}

    With as many coordinates as latents that is the change of variables, :math:`|\det W|`, and a Gaussian
    stays one. With fewer, :math:`\sqrt{\det W W^\top}` is the co-area factor: the density integrates to
    one across the fibres :math:`\{Z : W Z + b = y\}` and is flat along them, which is what a virtual
    measurement of :math:`y` says. A Gaussian :math:`\mathcal N(\mu, S)` then gives a
    :class:`GaussianFactor` in the Kalman filter's information form,
    :math:`\Lambda = W^\top S^{-1} W`, :math:`h = W^\top S^{-1} (\mu - b)`; the fused predictor fills in
    the other directions.

    Args:
        prior: of :math:`y`, for instance a :class:`GoalPrior` whose task is a position.
        matrix: :math:`W`, of shape ``(P, D)`` and rank ``P``; or an object with ``weight`` and ``bias``
            (:func:`~torchrl_vjepa.diagnostics.linear_probe`, ``nn.Linear``).
        offset: :math:`b`, of shape ``(P,)``; zero by default, not with an object.

    Raises:
        ValueError: if shapes do not fit, or the rank is less than ``P``: some combination of the
            coordinates is then the same for all latents.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import GoalPrior, diag_gaussian
        >>> position = ProbedPrior(GoalPrior(std=0.1), torch.tensor([[2.0, 0.0, 0.0]]))
        >>> position.energy(torch.tensor([[1.0, 9.0, 9.0], [2.0, 9.0, 9.0]]), torch.tensor([2.0])).round()
        tensor([ -2., 198.])
        >>> position(torch.tensor([2.0])).precision.diagonal()
        tensor([400.,   0.,   0.])
    """

    matrix: Tensor
    offset: Tensor
    log_volume: Tensor
    inverse: Tensor | None

    def __init__(self, prior: Prior, matrix: Any, offset: Tensor | float | None = None) -> None:
        matrix, offset = affine_map(matrix, offset)
        size, latent_dim = matrix.shape
        if prior.latent_dim not in (None, size):
            raise ValueError(
                f"prior must be one of the {size} coordinates of matrix {tuple(matrix.shape)}, "
                f"got latent_dim={prior.latent_dim}"
            )
        exact = matrix.double()
        values = torch.linalg.svdvals(exact)
        epsilon = torch.finfo(matrix.dtype).eps * max(size, latent_dim)
        if size > latent_dim or not values[-1] > epsilon * values[0]:
            raise ValueError(
                f"matrix must have rank P={size} to be a coordinate of latents, got {tuple(matrix.shape)} "
                f"with singular values {values.tolist()}; drop coordinates that others determine"
            )
        super().__init__(task_key=prior.task_key, task_ndim=prior.task_ndim, latent_dim=latent_dim)
        self.prior = prior
        self.differentiable = prior.differentiable
        self.register_buffer("matrix", matrix)
        self.register_buffer("offset", offset)
        self.register_buffer("log_volume", values.log().sum().to(matrix.dtype))
        square = size == latent_dim
        self.register_buffer("inverse", torch.linalg.inv(exact).to(matrix.dtype) if square else None)
        if not prior.in_keys:
            check_density(self())

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries that the prior reads."""
        return self.prior.in_keys

    def along(
        self, tasks: Mapping[NestedKey, Tensor] | TensorDictBase, batch_ndim: int, horizon: int
    ) -> dict[NestedKey, Tensor]:
        """See :meth:`Prior.along`: that of the prior.

        Args:
            tasks: holds the entries of ``in_keys``, with batch ``*B``.
            batch_ndim: how many dimensions ``*B`` has.
            horizon: how many steps.

        Returns:
            The entries with a time dimension behind ``*B``.
        """
        return self.prior.along(tasks, batch_ndim, horizon)

    def advanced(
        self, tasks: Mapping[NestedKey, Tensor] | TensorDictBase, batch_ndim: int
    ) -> dict[NestedKey, Tensor]:
        """See :meth:`Prior.advanced`: that of the prior.

        Args:
            tasks: holds the entries of ``in_keys``, with batch ``*B``.
            batch_ndim: how many dimensions ``*B`` has.

        Returns:
            The entries that change.
        """
        return self.prior.advanced(tasks, batch_ndim)

    def forward(self, task: Task = None) -> LatentDensity:
        """The density over latents.

        Args:
            task: what the prior of the coordinate reads.

        Returns:
            For a Gaussian a :class:`~torch.distributions.MultivariateNormal` where ``W`` is square, and a
            :class:`GaussianFactor` else; a :class:`Density` for others.

        Raises:
            ValueError: if the prior's events are not the ``P`` coordinates.
        """
        return self._pulled(self.prior(task))

    def _pulled(self, p: LatentDensity) -> LatentDensity:
        if isinstance(p, Density):
            if p.is_flat:
                return p
            # The volume is the base's, where there is one; energies are known up to a constant.
            base = None if p.base is None else self._pulled(p.base)
            energy = None if p.energy is None else (lambda latent: p.checked_energy(self._coordinate(latent)))
            if isinstance(base, Density):
                return Density(lambda latent: -self._log_prob(p, latent))
            return Density(energy, base)
        if tuple(p.event_shape) != (len(self.matrix),):
            raise ValueError(
                f"prior must give densities of the {len(self.matrix)} coordinates of the probe, got event "
                f"shape {tuple(p.event_shape)}"
            )
        if isinstance(p, GaussianFactor):
            return self._factor(p, p.precision, p.information)
        if not _is_gaussian(p):
            return Density(lambda latent: -self._log_prob(p, latent))
        if self.inverse is None:
            root = _inverse_root(p)
            precision = root.mT @ root
            return self._factor(p, precision, (precision @ p.mean.unsqueeze(-1)).squeeze(-1))
        inverse = self.inverse.to(p.mean.dtype)
        loc = (p.mean - self.offset.to(p.mean.dtype)) @ inverse.mT
        root = inverse @ _root(p)
        upper = torch.linalg.qr(root.mT).R  # a triangular root, without squaring the condition
        sign = torch.where(upper.diagonal(dim1=-2, dim2=-1) < 0, -1.0, 1.0).to(upper.dtype)
        return full_gaussian(loc, (sign.unsqueeze(-1) * upper).mT)

    def _factor(self, p: Any, precision: Tensor, information: Tensor) -> GaussianFactor:
        """In latents; ``precision`` and ``information`` are those of the coordinate."""
        matrix, offset = self.matrix.to(precision.dtype), self.offset.to(precision.dtype)
        return _PulledGaussian(
            matrix.mT @ precision @ matrix,
            (information - precision @ offset) @ matrix,
            lambda latent: self._log_prob(p, latent),
        )

    def _coordinate(self, latent: Tensor) -> Tensor:
        if latent.ndim == 0 or latent.shape[-1] != self.latent_dim:
            raise ValueError(
                f"latent must have last dimension {self.latent_dim}, got shape {tuple(latent.shape)}"
            )
        dtype = torch.promote_types(latent.dtype, self.matrix.dtype)
        return latent.to(dtype) @ self.matrix.to(dtype).mT + self.offset

    def _log_prob(self, p: Any, latent: Tensor) -> Tensor:
        return p.log_prob(self._coordinate(latent)) + self.log_volume


class _PulledGaussian(GaussianFactor):
    """A factor whose log-density is read in the coordinate, where no digits cancel."""

    def __init__(self, precision: Tensor, information: Tensor, log_prob: Any) -> None:
        zero = torch.zeros(information.shape[-1:], dtype=information.dtype, device=information.device)
        # At the origin the quadratic form vanishes: what is left is its constant.
        super().__init__(precision, information, log_prob(zero))
        self._exact_log_prob = log_prob

    def log_prob(self, latent: Tensor) -> Tensor:
        return self._exact_log_prob(latent)


def _is_gaussian(p: Distribution) -> bool:
    diagonal = isinstance(p, Independent) and isinstance(p.base_dist, Normal)
    return diagonal or isinstance(p, (MultivariateNormal, LowRankMultivariateNormal, LowRankGaussian))


def _root(p: Distribution) -> Tensor:
    r"""Of the covariance: :math:`L` with :math:`L L^\top = S`."""
    if isinstance(p, Independent):
        return torch.diag_embed(p.stddev)
    if isinstance(p, MultivariateNormal):
        return p.scale_tril
    return torch.linalg.cholesky(p.covariance_matrix)  # type: ignore[attr-defined]


def _inverse_root(p: Distribution) -> Tensor:
    if isinstance(p, Independent):
        return torch.diag_embed(p.stddev.reciprocal())
    root = _root(p)
    eye = torch.eye(root.shape[-1], dtype=root.dtype, device=root.device)
    return torch.linalg.solve_triangular(root, eye.expand_as(root), upper=False)
