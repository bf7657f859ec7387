"""Gaussian priors, fixed or learned."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.distributions import Distribution, MultivariateNormal

from torchrl_vjepa.distributions import diag_gaussian
from torchrl_vjepa.priors.arguments import finite_vector, std_vector
from torchrl_vjepa.priors.base import Prior, Task

__all__ = ["GaussianPrior"]


class GaussianPrior(Prior):
    r"""Gaussian over latents, :math:`p(Z) = \mathcal N(\mu, \Sigma)`; fixed or learned.

    The learned diagonal one, starting at :math:`\mathcal N(0, I)`, is the static structural prior of the
    paper's experiment ("Note on BJEPA Priors"); the fixed unit one is its reference prior.

    Args:
        latent_dim: size ``D`` of the latent.
        mean: :math:`\mu`, a number or ``(D,)``.
        std: standard deviations, a number or ``(D,)``; with ``covariance`` they must not be given.
        covariance: :math:`\Sigma`, ``(D, D)``, for a full Gaussian.
        learnable: whether :math:`\mu` and :math:`\Sigma` are parameters.

    Raises:
        ValueError: if a size or shape is wrong, ``std`` is not positive or its precision overflows,
            or ``covariance`` is not symmetric positive definite.

    Examples:
        >>> import torch
        >>> prior = GaussianPrior(2, mean=1.0, std=0.5)
        >>> prior().mean, prior.log_prob(torch.ones(3, 2)).shape
        (tensor([1., 1.]), torch.Size([3]))
    """

    mean: Tensor
    log_var: Tensor
    log_diagonal: Tensor
    lower: Tensor

    def __init__(
        self,
        latent_dim: int,
        *,
        mean: Tensor | float = 0.0,
        std: Tensor | float | None = None,
        covariance: Tensor | None = None,
        learnable: bool = False,
    ) -> None:
        super().__init__(latent_dim=latent_dim)
        if latent_dim < 1:
            raise ValueError(f"latent_dim must be positive, got {latent_dim}")
        if std is not None and covariance is not None:
            raise ValueError("at most one of std and covariance must be given, got both")
        entries = {"mean": finite_vector("mean", mean, latent_dim)}
        if covariance is None:
            scale = std_vector("std", 1.0 if std is None else std, latent_dim)
            entries["log_var"] = 2 * scale.log()
        else:
            if tuple(covariance.shape) != (latent_dim, latent_dim):
                raise ValueError(
                    f"covariance must have shape {(latent_dim, latent_dim)}, got {tuple(covariance.shape)}"
                )
            covariance = covariance.detach().to(entries["mean"].dtype)
            factor, failed = torch.linalg.cholesky_ex(covariance)
            if failed or not torch.allclose(covariance, covariance.mT):
                raise ValueError("covariance must be symmetric positive definite")
            entries["log_diagonal"] = factor.diagonal().log()
            entries["lower"] = factor.tril(-1)
        for name, value in entries.items():
            if learnable:
                self.register_parameter(name, nn.Parameter(value.clone()))
            else:
                self.register_buffer(name, value.clone())
        self._initial = {name: value.clone() for name, value in entries.items()}

    @property
    def stackable(self) -> bool:
        """Whether it takes the stacked parameters of several models: the diagonal one does."""
        return hasattr(self, "log_var")

    def reset_parameters(self) -> None:
        """Back to the Gaussian that was given."""
        with torch.no_grad():
            for name, value in self._initial.items():
                getattr(self, name).copy_(value)

    def forward(self, task: Task = None) -> Distribution:
        """The Gaussian; it does not depend on the task.

        Args:
            task: not used.

        Returns:
            Distribution with empty batch and event ``(D,)``; with stacked parameters of ``N``
            models the batch is ``(N, 1)``, which broadcasts against their rows.
        """
        if hasattr(self, "log_var"):
            mean, log_var = self.mean, self.log_var
            if mean.ndim == 2:  # of several models: the rows of each share it
                mean, log_var = mean.unsqueeze(-2), log_var.unsqueeze(-2)
            return diag_gaussian(mean, log_var=log_var)
        factor = self.lower.tril(-1) + torch.diag_embed(self.log_diagonal.exp())
        return MultivariateNormal(self.mean, scale_tril=factor, validate_args=False)
