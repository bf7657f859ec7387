"""A linear sensor: the observation model for which the best proposal is known."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.distributions import Distribution, MultivariateNormal

from torchrl_vjepa.distributions import moments

__all__ = ["LinearObservation"]


class LinearObservation(nn.Module):
    r"""Observation model :math:`p_\psi(x \mid Z) = \mathcal N(H Z, R)` (``eq:vjepa_obs_model_optional``).

    As a likelihood of the particle filter (option A) it gives the log-density; :meth:`condition` is the
    proposal that makes the filter cope with a sharp sensor: for a Gaussian prediction it is the exact
    :math:`p(Z_{t+1} \mid Z^{(k)}_t, u_t, x_{t+1})`, and the weights do not depend on the draw.

    Args:
        matrix: :math:`H`, of shape ``(O, D)``.
        std: standard deviation of the sensor's noise, a number or ``(O,)``, in units of the observation:
            :math:`R = \mathrm{diag}(\texttt{std}^2)`.

    Raises:
        ValueError: if the matrix is no finite matrix, or ``std`` is not positive or has another shape.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import LinearGaussianSystem, ParticleFilter, diag_gaussian
        >>> system = LinearGaussianSystem(seed=0)  # sensor noise of 0.01
        >>> sensor = LinearObservation(system.C, system.sensor_std)
        >>> def transition(latent, action):
        ...     return diag_gaussian(latent @ system.A.mT, 0.1 * torch.ones(1))
        >>> filter = ParticleFilter(
        ...     transition, sensor, proposal=sensor.condition, latent_dim=4, action_dim=0, dtype=torch.float64
        ... )
        >>> data = system.simulate(50, noise_scale=0.0, dtype=torch.float64)
        >>> out = filter.filter(data["observation"], data["action"])
        >>> bool((out["mean"] - data["signal"]).square().mean() < 1e-3)
        True
    """

    matrix: Tensor
    std: Tensor

    def __init__(self, matrix: Tensor, std: Tensor | float) -> None:
        super().__init__()
        if matrix.ndim != 2 or not matrix.isfinite().all():
            raise ValueError(f"matrix must be finite with shape (O, D), got shape {tuple(matrix.shape)}")
        std = torch.as_tensor(std, dtype=matrix.dtype, device=matrix.device)
        if std.ndim == 0:
            std = std.expand(len(matrix))
        if std.shape != matrix.shape[:1] or not ((std > 0) & std.isfinite()).all():
            raise ValueError(
                f"std must be positive, a number or of shape {(len(matrix),)}, got {std.tolist()}"
            )
        self.register_buffer("matrix", matrix)
        self.register_buffer("std", std.clone())

    def forward(self, observation: Tensor, latent: Tensor) -> Tensor:
        """Log-density of the observation.

        Args:
            observation: of shape ``(*B, 1, O)``, or one that broadcasts with the latents.
            latent: of shape ``(*B, K, D)``.

        Returns:
            ``(*B, K)``, in nats.
        """
        whitened = (observation.to(latent.dtype) - latent @ self.matrix.mT) / self.std
        constant = self.std.log().sum() + 0.5 * len(self.std) * math.log(2 * math.pi)
        return -0.5 * whitened.square().sum(-1) - constant

    def condition(self, p: Distribution, observation: Tensor) -> MultivariateNormal:
        r"""The prediction, corrected by the observation: a Kalman update in precision form.

        .. math::
            \Lambda = P^{-1} + H^\top R^{-1} H, \qquad
            \mu = \Lambda^{-1} (P^{-1} m + H^\top R^{-1} x)

        Args:
            p: prediction with batch ``(*B, K)``, mean :math:`m` and covariance :math:`P`, which must not be
                singular; exact if it is Gaussian.
            observation: of shape ``(*B, 1, O)``.

        Returns:
            Gaussian with batch ``(*B, K)`` and event ``(D,)``.
        """
        mean, covariance = moments(p)
        factor = torch.linalg.cholesky(covariance)
        prior = torch.cholesky_inverse(factor)
        weighted = self.matrix / self.std.square().unsqueeze(-1)
        pull = (prior @ mean.unsqueeze(-1)).squeeze(-1) + observation.to(mean.dtype) @ weighted
        precision = torch.linalg.cholesky(prior + self.matrix.mT @ weighted)
        loc = torch.cholesky_solve(pull.unsqueeze(-1), precision).squeeze(-1)
        # A lower factor of the covariance, from the factor of the precision: no second inversion.
        eye = torch.eye(mean.shape[-1], dtype=mean.dtype, device=mean.device).expand_as(precision)
        root = torch.linalg.solve_triangular(precision, eye, upper=False)
        scale_tril = torch.linalg.cholesky(root.mT @ root)
        return MultivariateNormal(loc, scale_tril=scale_tril, validate_args=False)
