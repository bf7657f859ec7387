"""Structural priors: what the dynamics should look like, in training."""

from __future__ import annotations

import math

import torch
from tensordict import NestedKey
from torch import Tensor
from torch.distributions import Distribution, Independent, Laplace, StudentT

from torchrl_vjepa.distributions import diag_gaussian
from torchrl_vjepa.priors.arguments import std_vector
from torchrl_vjepa.priors.base import Prior, Task

__all__ = ["SlownessPrior", "SparsityPrior"]


class SlownessPrior(Prior):
    r"""Slow latents, :math:`p_{\text{struct}}(Z_T \mid Z_C) = \mathcal N(Z_C, \sigma^2 I)`.

    As ``structural_prior`` of a :class:`~torchrl_vjepa.models.BJEPA` it asks the prediction to stay near
    its context (section "Training with Structural Priors"):

    .. math::
        \mathrm{KL} = \tfrac12 \sum_d \big[(\mu_d - Z_{C,d})^2 / \sigma_d^2 + \sigma_{p,d}^2 / \sigma_d^2
        - 1 - \log(\sigma_{p,d}^2 / \sigma_d^2)\big]

    The task is the context latent, which :class:`~torchrl_vjepa.objectives.BJEPALoss` hands over; in
    planning the present latent. The scale of latents is not fixed by it: use it with an entropy term, or
    it shrinks them. All skips have the same :math:`\sigma`.

    Args:
        latent_dim: ``D``.
        std: :math:`\sigma`, a number or ``(D,)``: how far a latent may move between context and target.
        task_key: entry of the context: the model's ``latent_key``.
        detach_context: whether the context is a constant: the term then moves the prediction towards the
            context. By default it is the exact gradient, which also moves the context, so that the
            encoder finds slow features.

    Raises:
        ValueError: if ``std`` is not positive or has another shape.

    Examples:
        >>> import torch
        >>> SlownessPrior(2, std=0.1)({"latent": torch.ones(5, 2)}).mean.shape
        torch.Size([5, 2])
    """

    stackable = True
    std: Tensor

    def __init__(
        self,
        latent_dim: int,
        std: Tensor | float,
        *,
        task_key: NestedKey = "latent",
        detach_context: bool = False,
    ) -> None:
        super().__init__(task_key=task_key, latent_dim=latent_dim)
        self.register_buffer("std", std_vector("std", std, latent_dim))
        self.detach_context = detach_context

    def forward(self, task: Task = None) -> Distribution:
        """The Gaussian around the context.

        Args:
            task: :math:`Z_C`, of shape ``(*B, D)``, or a mapping.

        Returns:
            Distribution with batch ``*B`` and event ``(D,)``.

        Raises:
            ValueError: if the context has another size.
        """
        context = self.own_task(task)
        if context.ndim == 0 or context.shape[-1] != self.latent_dim:
            raise ValueError(
                f"task must be the context, of shape (*B, {self.latent_dim}), got {tuple(context.shape)}"
            )
        if self.detach_context:
            context = context.detach()
        return diag_gaussian(context, _of_models(self.std))


class SparsityPrior(Prior):
    r"""Sparse latents, :math:`p_{\text{struct}}(Z_T) = \prod_d \mathrm{Laplace}(Z_{T,d}; 0, b_d)`.

    As ``structural_prior`` of a :class:`~torchrl_vjepa.models.BJEPA` it asks that most dimensions be near
    zero (section "Training with Structural Priors"). For a diagonal prediction the divergence is known:

    .. math::
        \mathrm{KL} = \sum_d \frac{\mathbb E|Z_d|}{b_d} + \log 2 b_d - \tfrac12 \log 2 \pi e \sigma_d^2,
        \qquad \mathbb E|Z_d| = \sigma_d \sqrt{2 / \pi}\, e^{-\mu_d^2 / 2 \sigma_d^2}
        + \mu_d\, \mathrm{erf}\big(\mu_d / \sqrt{2 \sigma_d^2}\big)

    Args:
        latent_dim: ``D``.
        scale: :math:`b`, a number or ``(D,)``; of Student's :math:`t` the same letter.
        degrees: degrees of freedom of Student's :math:`t` in place of Laplace: heavier tails, a few
            dimensions may be large at little cost. The divergence is then sampled.

    Raises:
        ValueError: if ``scale`` is not positive or has another shape, or ``degrees`` is not positive.

    Examples:
        >>> import torch
        >>> SparsityPrior(2, scale=0.5).energy(torch.tensor([[0.5, 0.0], [1.0, 0.0]]))
        tensor([1., 2.])
    """

    stackable = True
    scale: Tensor

    def __init__(self, latent_dim: int, *, scale: Tensor | float = 1.0, degrees: float | None = None) -> None:
        super().__init__(latent_dim=latent_dim)
        self.register_buffer("scale", std_vector("scale", scale, latent_dim))
        if degrees is not None and not 0 < degrees < math.inf:
            raise ValueError(f"degrees must be positive and finite, got {degrees}")
        self.degrees = degrees

    def forward(self, task: Task = None) -> Distribution:
        """The density; it does not depend on the task.

        Args:
            task: not used.

        Returns:
            Distribution with empty batch and event ``(D,)``; of ``N`` stacked models, batch ``(N, 1)``.
        """
        scale = _of_models(self.scale)
        zero = torch.zeros_like(scale)
        if self.degrees is None:
            return Independent(Laplace(zero, scale, validate_args=False), 1, validate_args=False)
        degrees = torch.full_like(scale, self.degrees)
        return Independent(StudentT(degrees, zero, scale, validate_args=False), 1, validate_args=False)


def _of_models(value: Tensor) -> Tensor:
    """``(D,)``, or with stacked buffers of ``N`` models ``(N, 1, D)``: their rows share it."""
    return value.unsqueeze(-2) if value.ndim == 2 else value
