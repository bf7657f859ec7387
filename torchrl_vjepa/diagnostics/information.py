"""How much latents now tell of latents later: the mutual information bound."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_vjepa.statistics import gaussian_entropy

__all__ = ["mutual_information_bound"]


def mutual_information_bound(
    log_prob: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    *,
    eps: float = 1e-6,
) -> Tensor:
    r"""Variational lower bound on the information between latents now and later, in nats.

    Theorem ``thm:mi_bound``, with the Gaussian entropy of the target latents:

    .. math::
        I(Z_t; Z_{t+\Delta}) \ge
        \mathbb{E}\big[\log p_\phi(Z_{t+\Delta} \mid Z_t)\big] + H(Z_{t+\Delta})

    The bound is tight when :math:`p_\phi` is the true conditional. The entropy is the one of the
    Gaussian with the targets' covariance (:func:`torchrl_vjepa.statistics.gaussian_entropy`). It
    is exact for Gaussian latents and an *upper* bound on the entropy otherwise, so that for
    strongly non-Gaussian latents the value can exceed the true information. Differentiable.

    Args:
        log_prob: :math:`\log p_\phi(z' \mid z)` of each target, shape ``(*B)``.
        target: The target latents :math:`z'`, shape ``(*B, D)``.
        mask: Boolean, shape ``(*B)`` or ``(*B, 1)``; ``False`` marks a pair that does not count
            (across an episode's end, or padded).
        eps: Variance added to every direction in the entropy, above 0.

    Returns:
        A scalar; NaN if the mask leaves nothing.

    Raises:
        ValueError: If shapes do not fit or ``eps`` is not positive.
        TypeError: If ``target`` is not floating point or the mask is not boolean.

    Examples:
        >>> import torch
        >>> target = torch.tensor([[-1.0], [1.0]])
        >>> marginal = torch.distributions.Normal(0.0, 1.0)
        >>> bound = mutual_information_bound(marginal.log_prob(target).sum(-1), target)
        >>> abs(bound.item()) < 1e-5  # a model that ignores the context explains nothing
        True
    """
    if log_prob.shape != target.shape[:-1]:
        raise ValueError(
            f"log_prob must have shape {tuple(target.shape[:-1])} to fit target of shape "
            f"{tuple(target.shape)}, got {tuple(log_prob.shape)}; sum it over the last "
            f"dimension if it is one value per component."
        )
    entropy = gaussian_entropy(target, mask, eps=eps)
    if mask is None:
        return log_prob.mean() + entropy
    mask = mask.reshape(log_prob.shape)
    return torch.where(mask, log_prob, 0).sum() / mask.sum() + entropy
