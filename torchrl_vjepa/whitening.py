"""Whitening of observations: running moments, frozen while a model acts."""

from __future__ import annotations

import math
from typing import Literal

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from torchrl_vjepa.statistics import masked_moments

__all__ = ["Whitening", "check_observation", "check_size"]


def check_size(name: str, value: int) -> None:
    """Refuse a size that is not a positive integer.

    Args:
        name: Name of the argument, for the message.
        value: The size.

    Raises:
        ValueError: If it is no integer of at least 1.

    Examples:
        >>> check_size("latent_dim", 4)
    """
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise ValueError(f"{name} must be an integer of at least 1, got {value!r}.")


def check_observation(
    observation: Tensor, observation_dim: int, key: NestedKey, dtype: torch.dtype | None = None
) -> None:
    """Check shape and dtype; values are not looked at, which would synchronise the device.

    Args:
        observation: What to check, shape ``(*B, O)``.
        observation_dim: Expected features :math:`O`.
        key: Its name, for the message.
        dtype: Dtype of the weights that read it; any floating point by default.

    Raises:
        ValueError: If the last dimension is not ``O``.
        TypeError: If the dtype does not fit.

    Examples:
        >>> import torch
        >>> check_observation(torch.zeros(3, 2), 2, "observation")
    """
    if observation.ndim == 0 or observation.shape[-1] != observation_dim:
        raise ValueError(f"{key!r} must have shape (*B, {observation_dim}), got {tuple(observation.shape)}.")
    if not observation.is_floating_point():
        raise TypeError(f"{key!r} must be floating point, got {observation.dtype}; cast it first.")
    if dtype is None or observation.dtype == dtype:
        return
    if not torch.is_autocast_enabled(observation.device.type):
        raise TypeError(
            f"{key!r} must have the dtype of the encoder's weights, {dtype}, got "
            f"{observation.dtype}; cast one of them (TorchRL's DoubleToFloat does it in an "
            f"environment)."
        )


class Whitening(nn.Module):
    r"""Affine map that gives observations zero mean and identity covariance.

    .. math::
        y = (x - \mu) \, W, \qquad W = U \operatorname{diag}\big(\max(\lambda, f)^{-1/2}\big) U^\top

    with :math:`\Sigma = U \operatorname{diag}(\lambda) U^\top` the covariance of everything seen
    so far (divided by the number of samples) and :math:`f` the floor under its eigenvalues: the
    symmetric (ZCA) root, so that the output stays as close to the input as whitening allows.

    Statistics change in :meth:`update` only, never in :meth:`forward`: acting and training see a
    frozen map. Before the first update it is the identity. While everything seen is constant
    (one sample, for instance) only the mean is removed. Batches are merged exactly: the order
    and size of updates do not matter. Update with many more samples than ``observation_dim``;
    directions without variance are divided by the root of the floor.

    State is in buffers only (``state_dict``, ``torch.func.functional_call``, ``torch.func.vmap``,
    dtype casts). Updates are in place, so whoever shares the buffers sees them; a *copy* of them
    does not. A target encoder is a copy: fit the whitening before building the loss.

    Args:
        observation_dim: Number of features :math:`O`, at least 1.
        eps: Floor under the eigenvalues, above 0.
        floor: ``"relative"``: :math:`f` is ``eps`` times the largest eigenvalue;
            ``"absolute"``: :math:`f` is ``eps``, in the units of the observation squared.

    Attributes:
        count: Number of samples seen, int64.
        mean: Shape ``(O,)``, float64.
        covariance: Shape ``(O, O)``, float64.
        transform: :math:`W`, shape ``(O, O)``.
        inverse_transform: :math:`W^{-1}`, shape ``(O, O)``.

    Raises:
        ValueError: If ``observation_dim``, ``eps`` or ``floor`` is out of range.

    Examples:
        >>> import torch
        >>> generator = torch.Generator().manual_seed(0)
        >>> observation = torch.randn(1000, 2, generator=generator) * 5 + 3
        >>> whitening = Whitening(2)
        >>> whitening.update(observation)
        >>> covariance = torch.cov(whitening(observation).mT, correction=0)
        >>> torch.allclose(covariance, torch.eye(2), atol=1e-4)
        True
        >>> torch.allclose(whitening.inverse(whitening(observation)), observation, atol=1e-4)
        True
    """

    count: Tensor
    mean: Tensor
    covariance: Tensor
    transform: Tensor
    inverse_transform: Tensor

    def __init__(
        self,
        observation_dim: int,
        *,
        eps: float = 1e-8,
        floor: Literal["relative", "absolute"] = "relative",
    ) -> None:
        super().__init__()
        check_size("observation_dim", observation_dim)
        if not 0 < eps < float("inf"):
            raise ValueError(f"eps must be positive and finite, got {eps}.")
        if floor not in ("relative", "absolute"):
            raise ValueError(f"floor must be 'relative' or 'absolute', got {floor!r}.")
        self.observation_dim = observation_dim
        self.eps = eps
        self.floor = floor
        self.register_buffer("count", torch.zeros((), dtype=torch.int64))
        self.register_buffer("mean", torch.zeros(observation_dim, dtype=torch.float64))
        self.register_buffer("covariance", torch.zeros(observation_dim, observation_dim, dtype=torch.float64))
        self.register_buffer("transform", torch.eye(observation_dim))
        self.register_buffer("inverse_transform", torch.eye(observation_dim))

    @torch.no_grad()
    def update(self, observation: Tensor, mask: Tensor | None = None) -> None:
        """Merge observations into the running statistics and renew the map.

        Args:
            observation: Shape ``(*B, O)``; all leading dimensions are samples. An empty batch
                changes nothing.
            mask: Boolean, shape ``(*B)`` or ``(*B, 1)``; ``False`` marks a padded row, which may
                hold anything.

        Raises:
            ValueError: If a shape does not fit or a row that counts is NaN or infinite. The
                state is unchanged then.
            TypeError: If ``observation`` is not floating point or ``mask`` not boolean.

        Examples:
            >>> import torch
            >>> whitening = Whitening(1)
            >>> whitening.update(torch.tensor([[1.0], [3.0]]))
            >>> whitening.update(torch.tensor([[5.0], [0.0]]), torch.tensor([True, False]))
            >>> whitening.count.item(), whitening.mean.item()
            (3, 3.0)
        """
        check_observation(observation, self.observation_dim, "observation")
        if observation.numel() == 0:
            return
        batch_mean, batch_covariance = masked_moments(observation.double(), mask)
        rows = observation.numel() // self.observation_dim
        added = rows if mask is None else int(mask.sum())
        # A value that is not finite always shows in the moments, and masked ones never do.
        if not (torch.isfinite(batch_mean).all() and torch.isfinite(batch_covariance).all()):
            raise ValueError(
                "observation must be finite, with a finite covariance, in every row that counts; "
                "got NaN, infinite or overflowing values. Clean them or mask those rows out "
                "(mask=False); the whitening is unchanged."
            )
        if added == 0:
            return
        # Chan, Golub and LeVeque: exact merge of two sets of moments.
        seen = int(self.count)
        count = seen + added
        shift = batch_mean - self.mean.double()
        mean = self.mean.double() + (added / count) * shift
        between = (math.sqrt(seen * added) / count) * shift
        covariance = (
            (seen / count) * self.covariance.double()
            + (added / count) * batch_covariance
            + torch.outer(between, between)
        )
        if not torch.isfinite(covariance).all():
            raise ValueError(
                "observation must be small enough for a finite covariance, got one that overflows; "
                "rescale it. The whitening is unchanged."
            )
        transform, inverse_transform = self._roots(covariance)
        # In place: a loss or another module that shares these buffers sees the update.
        self.count.fill_(count)
        self.mean.copy_(mean)
        self.covariance.copy_(covariance)
        self.transform.copy_(transform)
        self.inverse_transform.copy_(inverse_transform)

    def forward(self, observation: Tensor) -> Tensor:
        """Whiten observations with the statistics as they stand.

        Args:
            observation: Shape ``(*B, O)``, of the dtype of ``transform``.

        Returns:
            Whitened observations, shape ``(*B, O)``.

        Raises:
            ValueError: If the last dimension is not ``O``.
            TypeError: If ``observation`` is not floating point.

        Examples:
            >>> import torch
            >>> Whitening(2)(torch.tensor([1.0, 2.0])).tolist()  # nothing seen yet
            [1.0, 2.0]
        """
        check_observation(observation, self.observation_dim, "observation")
        return (observation - self.mean.to(self.transform.dtype)) @ self.transform

    def inverse(self, whitened: Tensor) -> Tensor:
        """Undo :meth:`forward`.

        Args:
            whitened: Shape ``(*B, O)``.

        Returns:
            Observations, shape ``(*B, O)``.

        Raises:
            ValueError: If the last dimension is not ``O``.
            TypeError: If ``whitened`` is not floating point.

        Examples:
            >>> import torch
            >>> whitening = Whitening(1)
            >>> whitening.update(torch.tensor([[0.0], [4.0]]))
            >>> whitening.inverse(torch.tensor([1.0])).tolist()
            [4.0]
        """
        check_observation(whitened, self.observation_dim, "whitened")
        return whitened @ self.inverse_transform + self.mean.to(self.inverse_transform.dtype)

    def extra_repr(self) -> str:
        """Arguments of the constructor, for ``repr``."""
        return f"observation_dim={self.observation_dim}, eps={self.eps}, floor={self.floor!r}"

    def _roots(self, covariance: Tensor) -> tuple[Tensor, Tensor]:
        """Inverse root and root of the floored covariance, both symmetric."""
        values, vectors = torch.linalg.eigh(covariance)
        largest = values[-1]
        if largest <= 0:
            identity = torch.eye(self.observation_dim, dtype=values.dtype, device=values.device)
            return identity, identity
        scale = values.clamp(min=self.eps * largest if self.floor == "relative" else self.eps)
        return (vectors * scale.rsqrt()) @ vectors.mT, (vectors * scale.sqrt()) @ vectors.mT
