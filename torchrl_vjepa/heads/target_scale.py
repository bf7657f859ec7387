"""Scale of the target distribution."""

from __future__ import annotations

import math
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from torchrl_vjepa.distributions import soft_clamp
from torchrl_vjepa.heads.base import checked_range
from torchrl_vjepa.stacking import linear

__all__ = ["TargetScale"]

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
        self.log_var_range = None if log_var_range is None else checked_range(log_var_range)
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
            Of shape ``(*B, D)``; where it does not depend on the observation ``(D,)``, or ``(N, 1, D)`` with
            the stacked parameters of ``N`` models.
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
