"""What a representation holds of known quantities: the linear probe of the paper's experiment."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["LinearProbe", "linear_probe"]


class LinearProbe(NamedTuple):
    r"""A fitted linear regression from latents to targets, :math:`\hat s = W z + b`.

    Attributes:
        weight: :math:`W`, shape ``(S, D)``, float64 on the CPU.
        bias: :math:`b`, shape ``(S,)``, float64 on the CPU.
        r2_train: Coefficient of determination on the training samples, at most 1.
        r2_test: Coefficient of determination on the test samples, at most 1 (negative if the
            prediction is worse than the mean of the test targets).

    Examples:
        >>> import torch
        >>> probe = LinearProbe(torch.eye(2).double(), torch.ones(2).double(), 1.0, 0.9)
        >>> probe.predict(torch.zeros(3, 2)).shape
        torch.Size([3, 2])
    """

    weight: Tensor
    bias: Tensor
    r2_train: float
    r2_test: float

    def predict(self, latent: Tensor) -> Tensor:
        """Predict targets from latents.

        Args:
            latent: Shape ``(*B, D)``, any floating dtype and device.

        Returns:
            Predicted targets, shape ``(*B, S)``, float64 on the CPU.

        Raises:
            ValueError: If the last dimension of ``latent`` is not ``D``.

        Examples:
            >>> import torch
            >>> latent = torch.arange(4.0).unsqueeze(-1)
            >>> probe = linear_probe(latent, 2 * latent + 1, latent, 2 * latent + 1)
            >>> [round(v, 6) for v in probe.predict(torch.tensor([10.0])).tolist()]
            [21.0]
        """
        if latent.ndim == 0 or latent.shape[-1] != self.weight.shape[-1]:
            raise ValueError(
                f"latent must have last dimension {self.weight.shape[-1]} (the probe's latent "
                f"size), got shape {tuple(latent.shape)}."
            )
        return latent.detach().to(self.weight) @ self.weight.mT + self.bias


def linear_probe(
    latent_train: Tensor,
    target_train: Tensor,
    latent_test: Tensor,
    target_test: Tensor,
) -> LinearProbe:
    r"""Fit targets from latents by ordinary least squares and score the fit on held-out data.

    The protocol of the paper's section "Linear Probe Evaluation Protocol":

    .. math::
        \hat{s} = W z + b, \qquad
        R^2 = 1 - \frac{\sum_i \| s_i - \hat{s}_i \|^2}{\sum_i \| s_i - \bar{s} \|^2}

    with :math:`\bar s` the mean of the targets that are scored (the test targets for
    ``r2_test``). Sums run over samples and target components together, so components weigh by
    their variance. Computed in float64; with collinear latents the solution of smallest norm is
    taken.

    Args:
        latent_train: Latents to fit, shape ``(*B, D)``; leading dimensions are samples, at least
            ``D + 1`` of them.
        target_train: Targets to fit, shape ``(*B, S)``.
        latent_test: Held-out latents, shape ``(*C, D)``, at least 2 samples.
        target_test: Held-out targets, shape ``(*C, S)``.

    Returns:
        The fitted :class:`LinearProbe`. A score is NaN where the targets that it is computed on
        are constant: there is no variance to explain.

    Raises:
        TypeError: If an argument is not floating point.
        ValueError: If shapes do not fit, samples are too few, or a value is NaN or infinite.

    Examples:
        >>> import torch
        >>> generator = torch.Generator().manual_seed(0)
        >>> latent = torch.randn(100, 3, generator=generator)
        >>> signal = latent[:, :2] * 3 - 1
        >>> probe = linear_probe(latent[:80], signal[:80], latent[80:], signal[80:])
        >>> tuple(probe.weight.shape), round(probe.r2_test, 6)
        ((2, 3), 1.0)
    """
    _check_pair("latent_train", latent_train, "target_train", target_train)
    _check_pair("latent_test", latent_test, "target_test", target_test)
    for kind, train, test in (
        ("latent", latent_train, latent_test),
        ("target", target_train, target_test),
    ):
        if train.shape[-1] != test.shape[-1]:
            raise ValueError(
                f"{kind}_train and {kind}_test must have the same last dimension, got shapes "
                f"{tuple(train.shape)} and {tuple(test.shape)}."
            )
    latent_dim = latent_train.shape[-1]
    z, s, z_test, s_test = (
        x.detach().to(device="cpu", dtype=torch.float64).reshape(-1, x.shape[-1])
        for x in (latent_train, target_train, latent_test, target_test)
    )
    if len(z) < latent_dim + 1:
        raise ValueError(
            f"latent_train must hold at least latent dimension + 1 = {latent_dim + 1} samples, "
            f"got {len(z)}: with fewer, every target is fitted exactly."
        )
    if len(z_test) < 2:
        raise ValueError(f"latent_test must hold at least 2 samples, got {len(z_test)}.")

    z_mean, s_mean = _mean(z), _mean(s)
    # gelsd (by singular values) is the driver that is safe for rank-deficient latents.
    weight = torch.linalg.lstsq(z - z_mean, s - s_mean, driver="gelsd").solution.mT
    bias = s_mean - weight @ z_mean
    probe = LinearProbe(weight, bias, float("nan"), float("nan"))
    return probe._replace(r2_train=_r2(s, probe.predict(z)), r2_test=_r2(s_test, probe.predict(z_test)))


def _mean(x: Tensor) -> Tensor:
    """Mean over rows, exact for constant rows."""
    return x[0] + (x - x[0]).mean(0)


def _r2(target: Tensor, prediction: Tensor) -> float:
    total = (target - _mean(target)).square().sum()
    if total == 0:
        return float("nan")
    return (1 - (target - prediction).square().sum() / total).item()


def _check_pair(latent_name: str, latent: Tensor, target_name: str, target: Tensor) -> None:
    for name, x in ((latent_name, latent), (target_name, target)):
        if not x.is_floating_point():
            raise TypeError(f"{name} must be floating point, got {x.dtype}; cast it first.")
        if x.ndim < 2 or x.shape[-1] == 0:
            raise ValueError(
                f"{name} must have shape (*B, features) with samples in the leading dimensions, "
                f"got {tuple(x.shape)}."
            )
        if not torch.isfinite(x).all():
            raise ValueError(
                f"{name} must be finite, got NaN or infinite values in "
                f"{int((~torch.isfinite(x)).sum())} of {x.numel()} entries."
            )
    if latent.shape[:-1] != target.shape[:-1]:
        raise ValueError(
            f"{latent_name} and {target_name} must hold the same samples, got shapes "
            f"{tuple(latent.shape)} and {tuple(target.shape)}."
        )
