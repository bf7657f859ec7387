"""Heads: from the features of a predictor to a distribution over latents.

A head says how many features it wants (``num_features``), how many of its numbers do not depend on
the state (``num_constants``: the predictor keeps one learned row of them for every skip), and turns
both into a :class:`torch.distributions.Distribution` with event shape ``(D,)``.
"""

from __future__ import annotations

import math
from typing import Literal, get_args

import torch
from torch import Tensor, nn
from torch.distributions import Independent

from torchrl_vjepa.distributions import Delta, diag_gaussian, soft_clamp
from torchrl_vjepa.stacking import halves, linear

__all__ = ["DeltaHead", "DiagGaussianHead", "Head", "TargetScale", "soft_clamp"]


class Head(nn.Module):
    r"""What every head has: the sizes that it asks of the predictor, and ``forward``.

    ``forward(features (*B, F), constants (C,)) -> Distribution`` with batch ``*B`` and event ``(D,)``,
    where ``F = num_features(D)`` and ``C = num_constants(D)``. The first ``D`` features are the mean.
    A head that has no parameters and only broadcasts says so by ``stackable = True``: it is then called
    with features ``(N, R, F)`` and constants ``(N, 1, C)`` of several models at once
    (:func:`~torchrl_vjepa.stacking.linear`).

    Examples:
        >>> DeltaHead().num_features(4), DeltaHead().num_constants(4)
        (4, 0)
    """

    stackable = False

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


class DeltaHead(Head):
    r"""Deterministic head: :math:`p_\phi(Z_T \mid Z_C, \xi) = \delta(Z_T - g_\phi(Z_C, \xi))`.

    The deterministic JEPA of ``eq:context_predictor``.

    Examples:
        >>> import torch
        >>> DeltaHead()(torch.ones(2, 3), torch.empty(0)).mean.shape
        torch.Size([2, 3])
    """

    stackable = True

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
        self.log_var_range = _checked_range(log_var_range)

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


def _checked_range(log_var_range: tuple[float, float] | None) -> tuple[float, float] | None:
    if log_var_range is None:
        return None
    low, high = (float(bound) for bound in log_var_range)
    if not -math.inf < low < high < math.inf:
        raise ValueError(f"log_var_range must be finite (low, high) with low < high, got {log_var_range}")
    return low, high


TargetScaleKind = Literal["linear", "learned", "constant"]


class TargetScale(nn.Module):
    r"""Scale of the target distribution :math:`q_{\theta'}(Z_T \mid x_T)` (``eq:vjepa_inference_target``).

    Args:
        latent_dim: size ``D`` of the latent.
        observation_dim: size ``O`` of the observation; needed by ``kind="linear"`` only.
        kind: ``"linear"``: :math:`\log\sigma^2 = W x`, the second linear head of the paper's target
            encoder; ``"learned"``: one learned log-variance per dimension; ``"constant"``: fixed.
        init_std: standard deviation at the start (``"learned"``, ``"constant"``), in units of the latent.
        log_var_range: the log-variance is softly clamped to it, in nats; ``None`` leaves it unbounded.

    Raises:
        ValueError: if sizes are not positive, ``init_std`` is outside of the range, or ``kind`` is unknown.

    Examples:
        >>> import torch
        >>> TargetScale(3, kind="constant", init_std=0.5)(torch.zeros(2, 7))
        tensor([0.5000, 0.5000, 0.5000])
    """

    stackable = True

    def __init__(
        self,
        latent_dim: int,
        observation_dim: int | None = None,
        *,
        kind: TargetScaleKind = "learned",
        init_std: float = 1.0,
        log_var_range: tuple[float, float] | None = (-16.0, 16.0),
    ) -> None:
        super().__init__()
        if kind not in get_args(TargetScaleKind):
            raise ValueError(f"kind must be one of {get_args(TargetScaleKind)}, got {kind!r}")
        if latent_dim < 1:
            raise ValueError(f"latent_dim must be positive, got {latent_dim}")
        if not init_std > 0:
            raise ValueError(f"init_std must be positive, got {init_std}")
        if kind == "linear" and (observation_dim is None or observation_dim < 1):
            raise ValueError(f"observation_dim must be positive for kind='linear', got {observation_dim}")
        self.latent_dim = latent_dim
        self.kind = kind
        self.init_std = float(init_std)
        self.log_var_range = _checked_range(log_var_range)
        low, high = self.log_var_range or (-math.inf, math.inf)
        if kind != "linear" and not low <= 2.0 * math.log(self.init_std) <= high:
            raise ValueError(
                f"init_std must have a log-variance in log_var_range={log_var_range}, got "
                f"{init_std} with {2.0 * math.log(self.init_std):.3g}; widen the range"
            )
        if kind == "linear" and observation_dim is not None:
            self.linear = nn.Linear(observation_dim, latent_dim, bias=False)
            return
        log_var = torch.full((latent_dim,), 2.0 * math.log(self.init_std))
        if kind == "learned":
            self.log_var = nn.Parameter(log_var)
        else:
            self.register_buffer("log_var", log_var)

    def reset_parameters(self) -> None:
        """Back to the initial scale (``"linear"`` resets its layer itself)."""
        if self.kind == "learned":
            with torch.no_grad():
                self.log_var.fill_(2.0 * math.log(self.init_std))

    def log_variance(self, observation: Tensor) -> Tensor:
        r"""Log-variance :math:`\log \sigma^2_{\theta'}` of the target.

        Args:
            observation: target observation, of shape ``(*B, O)``.

        Returns:
            Of shape ``(*B, D)``; ``(D,)`` where it does not depend on the observation.
        """
        if self.kind == "linear":
            log_var = linear(observation, self.linear.weight)
        else:
            log_var = self.log_var if self.log_var.ndim == 1 else self.log_var.unsqueeze(-2)
        return log_var if self.log_var_range is None else soft_clamp(log_var, *self.log_var_range)

    def forward(self, observation: Tensor) -> Tensor:
        """Standard deviation of the target.

        Args:
            observation: target observation, of shape ``(*B, O)``.

        Returns:
            Standard deviations of shape ``(*B, D)``; ``(D,)`` where they do not depend on the
            observation.
        """
        return (0.5 * self.log_variance(observation)).exp()
