"""Mean and covariance of any distribution over latents."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, MixtureSameFamily

from torchrl_vjepa.distributions.delta import Delta
from torchrl_vjepa.distributions.sampling import sample

__all__ = ["moments"]


def moments(
    p: Distribution, *, num_samples: int = 4096, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    r"""Mean :math:`\mathbb E_p[Z]` and covariance :math:`\mathrm{Cov}_p[Z]`.

    Closed forms for a point, Gaussians, mixtures (law of total covariance) and whatever else states its
    own ``covariance_matrix`` or consists of independent dimensions with a variance; a
    :class:`CouplingFlow` averages over its fixed set of points. Others are sampled: their standard error
    is :math:`\sqrt{\mathrm{Var}/M}` for ``num_samples`` :math:`M`.

    Args:
        p: the distribution, batch ``*B`` and event ``(D,)``.
        num_samples: draws for a distribution whose moments torch does not know.
        generator: source of randomness for those draws.

    Returns:
        Mean ``(*B, D)`` and covariance ``(*B, D, D)``.

    Raises:
        ValueError: if the event is no vector, or ``num_samples`` is below 2.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> mean, covariance = moments(diag_gaussian(torch.zeros(5, 2), torch.tensor([1.0, 2.0])))
        >>> mean.shape, covariance[0]
        (torch.Size([5, 2]), tensor([[1., 0.],
                [0., 4.]]))
    """
    if len(p.event_shape) != 1:
        raise ValueError(f"p must have an event of shape (D,), got {tuple(p.event_shape)}")
    if num_samples < 2:
        raise ValueError(f"num_samples must be at least 2, got {num_samples}")
    if hasattr(p, "covariance_matrix"):
        return p.mean, p.covariance_matrix
    if isinstance(p, MixtureSameFamily):
        means, covariances = moments(p.component_distribution, num_samples=num_samples, generator=generator)
        return mixture_moments(p.mixture_distribution.probs, means, covariances)
    independent = isinstance(p, Independent) and p.reinterpreted_batch_ndims == 1
    if independent or isinstance(p, Delta):
        try:
            return p.mean, torch.diag_embed(p.variance)
        except NotImplementedError:
            pass
    draws = sample(p, (num_samples,), generator=generator)
    mean = draws.mean(0)
    centred = (draws - mean).movedim(0, -1)
    return mean, centred @ centred.mT / (num_samples - 1)


def mixture_moments(weights: Tensor, means: Tensor, covariances: Tensor) -> tuple[Tensor, Tensor]:
    r"""Law of total covariance, :math:`\mathbb E_k[\Sigma_k] + \mathrm{Cov}_k[\mu_k]`.

    Args:
        weights: of the components, ``(*B, K)``, summing to one.
        means: of shape ``(*B, K, D)``.
        covariances: of shape ``(*B, K, D, D)``.

    Returns:
        Mean ``(*B, D)`` and covariance ``(*B, D, D)``.
    """
    mean = (weights.unsqueeze(-1) * means).sum(-2)
    deviation = means - mean.unsqueeze(-2)
    between = deviation.mT @ (weights.unsqueeze(-1) * deviation)
    return mean, (weights[..., None, None] * covariances).sum(-3) + between
