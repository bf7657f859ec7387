"""One representative latent of a predictive distribution."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.distributions import Distribution

from torchrl_vjepa.distributions.modes import maximize_log_prob
from torchrl_vjepa.distributions.sampling import sample

__all__ = ["point_estimate"]


def point_estimate(
    p: Distribution,
    how: Literal["mean", "mode", "sample"] = "mean",
    *,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""One representative latent :math:`\hat Z_T` of a predictive distribution.

    The mean :math:`\mathbb E_p[Z_T]`, the mode (MAP) :math:`\arg\max p(Z_T)`, or one draw, as in the
    paper's section "Prediction and Uncertainty Propagation". The mode of a mixture or a flow is searched
    for (:func:`maximize_log_prob`).

    Args:
        p: the distribution, batch ``*B`` and event ``(D,)``.
        how: which point.
        generator: source of randomness for ``"sample"``.

    Returns:
        A latent of shape ``(*B, D)``.

    Raises:
        ValueError: if ``how`` is none of the three.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> point_estimate(diag_gaussian(torch.ones(2), torch.ones(2)), "mode")
        tensor([1., 1.])
    """
    if how == "mean":
        return p.mean
    if how == "mode":
        try:
            return p.mode
        except NotImplementedError:  # torch's mixtures and transformed distributions
            return maximize_log_prob(p)[0]
    if how == "sample":
        return sample(p, generator=generator)
    raise ValueError(f"how must be 'mean', 'mode' or 'sample', got {how!r}")
