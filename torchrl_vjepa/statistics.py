"""What a batch of latents looks like: moments, entropy, effective rank, distance to a Gaussian.

Everything here is masked by weights instead of boolean indexing, so that it runs under
``torch.func.vmap`` and ``torch.compile`` without leaving the graph. What the losses call takes
several sets of rows at once (one for each model).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchrl_vjepa.stacking import products

__all__ = [
    "covariance_entropy",
    "covariance_rank",
    "effective_rank",
    "eigenvalues",
    "gaussian_entropy",
    "masked_moments",
    "row_distance",
    "row_moments",
    "sliced_gaussian_distance",
    "spectrum_entropy",
    "spectrum_rank",
]


def masked_moments(x: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    r"""Mean and covariance of the rows of ``x`` that the mask keeps.

    .. math::
        \mu = \frac{1}{n} \sum_i m_i x_i, \qquad
        \Sigma = \frac{1}{n} \sum_i m_i (x_i - \mu)(x_i - \mu)^\top, \qquad n = \sum_i m_i

    All leading dimensions are one set of samples; for one result per run, map over the run
    dimension with :func:`torch.func.vmap`. The covariance is the population one (divided by
    :math:`n`). Masked rows may hold anything, NaN included. Half precision is computed in
    float32, and autocast is off inside. Differentiable in ``x``.

    Args:
        x: Samples, shape ``(*B, D)``, floating point, at least one row.
        mask: Boolean, shape ``(*B)`` or ``(*B, 1)``; ``False`` marks a row that does not count.
            Default: every row counts.

    Returns:
        ``mean`` of shape ``(D,)`` and ``covariance`` of shape ``(D, D)``. If no row is left,
        both are zero.

    Raises:
        ValueError: If ``x`` has no row or no feature dimension, or the mask another shape.
        TypeError: If ``x`` is not floating point or the mask is not boolean.

    Examples:
        >>> import torch
        >>> x = torch.tensor([[0.0, 1.0], [2.0, 1.0], [float("nan"), 9.0]])
        >>> mean, covariance = masked_moments(x, torch.tensor([True, True, False]))
        >>> mean.tolist(), covariance.tolist()
        ([1.0, 1.0], [[1.0, 0.0], [0.0, 0.0]])
    """
    return row_moments(*_as_rows(x, mask))


def row_moments(x: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Mean and covariance of rows, for several sets of them at once; see :func:`masked_moments`.

    Args:
        x: Samples, shape ``(*N, R, D)``, at least float32 and one row: ``*N`` sets of ``R`` rows.
        mask: Boolean, shape ``(R,)`` or ``(*N, R)``; ``False`` marks a row that does not count.

    Returns:
        ``mean`` of shape ``(*N, D)`` and ``covariance`` of shape ``(*N, D, D)``.

    Examples:
        >>> import torch
        >>> mean, covariance = row_moments(torch.tensor([[[0.0], [2.0]], [[1.0], [1.0]]]))
        >>> mean.flatten().tolist(), covariance.flatten().tolist()
        ([1.0, 1.0], [1.0, 0.0])
    """
    with torch.autocast(device_type=x.device.type, enabled=False):
        # Moments around one of the samples, not around zero: constant rows give exactly zero
        # variance, and a large common offset costs no digits.
        if mask is None:
            count: Tensor | int = x.shape[-2]
            shift = x[..., :1, :].detach()
            shifted = x - shift
        else:
            first = mask.to(torch.uint8).argmax(-1)[..., None, None]
            mask = mask.unsqueeze(-1)
            count = mask.sum((-2, -1)).to(x.dtype).clamp(min=1)[..., None]
            x = torch.where(mask, x, 0)
            shift = x.detach().take_along_dim(first.expand(*x.shape[:-2], 1, x.shape[-1]), -2)
            shifted = torch.where(mask, x - shift, 0)
        mean = shifted.sum(-2) / count
        scale = count.unsqueeze(-1) if isinstance(count, Tensor) else count
        covariance = products(shifted) / scale - mean.unsqueeze(-1) * mean.unsqueeze(-2)
    return shift.squeeze(-2) + mean, covariance


def gaussian_entropy(latents: Tensor, mask: Tensor | None = None, *, eps: float = 1e-6) -> Tensor:
    r"""Entropy of the Gaussian that has the latents' mean and covariance, in nats.

    .. math::
        H = \tfrac{1}{2} \log\det\big(2 \pi e \, (\Sigma + \epsilon I)\big)

    This is the largest entropy that any density with this covariance can have, and the marginal
    entropy :math:`H(Z_{t+\Delta})` of the mutual information bound (theorem ``thm:mi_bound``)
    when the latents are Gaussian. It is finite for collapsed latents too: never below
    :math:`\tfrac{D}{2} \log(2 \pi e \epsilon)`. Differentiable; its gradient in the covariance
    is bounded by :math:`1 / (2 \epsilon)`.

    Args:
        latents: Shape ``(*B, D)``; all leading dimensions are one set of samples.
        mask: Boolean, shape ``(*B)`` or ``(*B, 1)``; ``False`` marks a row that does not count.
        eps: Variance added to every direction, above 0 and in the units of the latents squared
            (absolute: a relative one would vanish just where latents collapse).

    Returns:
        A scalar. NaN if a latent that counts is NaN or infinite.

    Raises:
        ValueError: If ``eps`` is not positive, or for the shapes that
            :func:`masked_moments` refuses.
        TypeError: For the dtypes that :func:`masked_moments` refuses.

    Examples:
        >>> import math, torch
        >>> latents = torch.tensor([[-1.0], [1.0]])
        >>> entropy = gaussian_entropy(latents)
        >>> math.isclose(entropy.item(), 0.5 * math.log(2 * math.pi * math.e), abs_tol=1e-5)
        True
    """
    return covariance_entropy(masked_moments(latents, mask)[1], eps=eps)


def covariance_entropy(covariance: Tensor, *, eps: float = 1e-6) -> Tensor:
    r"""Entropy of a Gaussian with this covariance, in nats; see :func:`gaussian_entropy`.

    Args:
        covariance: Shape ``(*N, D, D)``, symmetric.
        eps: Variance added to every direction, above 0.

    Returns:
        Shape ``(*N)``. NaN where the covariance is not finite.

    Raises:
        ValueError: If ``eps`` is not positive.

    Examples:
        >>> import torch
        >>> round(covariance_entropy(torch.eye(2)).item(), 3)
        2.838
    """
    if not (eps > 0 and math.isfinite(eps)):
        raise ValueError(f"eps must be positive and finite, got {eps}.")
    return spectrum_entropy(eigenvalues(covariance), eps=eps)


def spectrum_entropy(values: Tensor, *, eps: float = 1e-6) -> Tensor:
    r"""Entropy of a Gaussian whose covariance has these eigenvalues, in nats; see :func:`gaussian_entropy`.

    Args:
        values: Shape ``(*N, D)``, at least 0: what :func:`eigenvalues` gives.
        eps: Variance added to every direction, above 0.

    Returns:
        Shape ``(*N)``.

    Examples:
        >>> import torch
        >>> round(spectrum_entropy(torch.ones(2)).item(), 3)
        2.838
    """
    return 0.5 * ((values + eps).log().sum(-1) + values.shape[-1] * math.log(2 * math.pi * math.e))


def eigenvalues(covariance: Tensor) -> Tensor:
    """Variances along the principal directions of a covariance, ascending.

    Args:
        covariance: Shape ``(*N, D, D)``, symmetric.

    Returns:
        Shape ``(*N, D)``, at least 0; NaN where the covariance is not finite, instead of an exception.

    Examples:
        >>> import torch
        >>> eigenvalues(torch.diag(torch.tensor([2.0, 1.0])))
        tensor([1., 2.])
    """
    finite = covariance.isfinite().all(-1).all(-1)[..., None, None]
    identity = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    values = torch.linalg.eigvalsh(torch.where(finite, covariance, identity)).clamp(min=0)
    return torch.where(finite.squeeze(-1), values, math.nan)


def effective_rank(latents: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""How many directions the latents really use: the effective rank of their covariance.

    .. math::
        \operatorname{erank}(\Sigma) = \exp\Big(-\sum_k p_k \log p_k\Big), \qquad
        p_k = \lambda_k / \textstyle\sum_j \lambda_j

    with :math:`\lambda_k` the eigenvalues of the covariance: the definition of Roy and Vetterli
    (2007) applied to the covariance matrix, whose singular values are its eigenvalues (applied
    to the data matrix it would use their square roots). Equal variance in :math:`r` orthogonal
    directions gives :math:`r`. It does not change under rotation, shift or a common scale.

    Args:
        latents: Shape ``(*B, D)``; all leading dimensions are one set of samples. For one value
            per run, map over the run dimension with :func:`torch.func.vmap`.
        mask: Boolean, shape ``(*B)`` or ``(*B, 1)``; ``False`` marks a row that does not count.

    Returns:
        A scalar in ``[1, D]``; 0 if the latents are constant (the rank of a zero covariance) or
        none is left by the mask; NaN if a latent that counts is NaN or infinite.

    Raises:
        ValueError: For the shapes that :func:`masked_moments` refuses.
        TypeError: For the dtypes that :func:`masked_moments` refuses.

    Examples:
        >>> import torch
        >>> plane = torch.tensor([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0]])
        >>> round(effective_rank(torch.cat([plane, -plane])).item(), 4)
        2.0
        >>> effective_rank(torch.ones(5, 3)).item()
        0.0
    """
    return covariance_rank(masked_moments(latents, mask)[1])


def covariance_rank(covariance: Tensor) -> Tensor:
    r"""Effective rank of a covariance; see :func:`effective_rank`.

    Args:
        covariance: Shape ``(*N, D, D)``, symmetric.

    Returns:
        Shape ``(*N)``, in ``[1, D]``; 0 for a zero covariance, NaN if it is not finite.

    Examples:
        >>> import torch
        >>> round(covariance_rank(torch.eye(3)).item(), 4)
        3.0
    """
    return spectrum_rank(eigenvalues(covariance))


def spectrum_rank(values: Tensor) -> Tensor:
    r"""Effective rank of a covariance that has these eigenvalues; see :func:`effective_rank`.

    Args:
        values: Shape ``(*N, D)``, at least 0: what :func:`eigenvalues` gives.

    Returns:
        Shape ``(*N)``, in ``[1, D]``; 0 if all are zero, NaN if they are not finite.

    Examples:
        >>> import torch
        >>> round(spectrum_rank(torch.ones(3)).item(), 4)
        3.0
    """
    # By the largest first: the sum of huge ones could overflow, and tiny ones would vanish.
    largest = values[..., -1:]
    scaled = values / torch.where(largest > 0, largest, 1)
    total = scaled.sum(-1, keepdim=True)
    share = scaled / torch.where(total > 0, total, 1)
    rank = torch.exp(-torch.special.xlogy(share, share).sum(-1))
    rank = rank.clamp(max=values.shape[-1])  # equal shares round above D
    return torch.where(total.squeeze(-1) == 0, 0, rank)


def sliced_gaussian_distance(
    latents: Tensor,
    mask: Tensor | None = None,
    *,
    num_slices: int = 64,
    num_points: int = 17,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""How far the latents are from :math:`\mathcal N(0, I)`, judged by random projections.

    .. math::
        \frac1S \sum_{s=1}^{S} \int \Big| \frac1n \sum_i m_i e^{\mathrm i t a_s^\top z_i}
        - e^{-t^2/2} \Big|^2 \mathcal N(t \mid 0, 1)\, dt,
        \qquad a_s \text{ uniform on the sphere}

    The sliced form of the entropy term for latents of many dimensions: sketched isotropic Gaussian
    regularisation (SIGReg; Balestriero and LeCun, "LeJEPA", 2025), the statistic of Epps and Pulley
    (1983) on one-dimensional projections. Where the moment form (:func:`gaussian_entropy`) needs a
    :math:`D \times D` covariance and sees two moments, this one costs :math:`O(n S (D + P))`, and is zero
    in the limit for the unit Gaussian alone. Unlike the test statistic it is not multiplied by
    :math:`n`: samples of :math:`\mathcal N(0, I)` give :math:`(1 - 3^{-1/2}) / n` on average; latents
    that have collapsed to the origin give 0.163, to a point far away 1.577.

    The integral is the trapezoidal rule on :math:`|t| \le 5`, which cannot resolve projections beyond
    :math:`\pm 0.6\, (P - 1)`: whiten or normalise latents of a much larger scale first. Differentiable
    in the latents. For one value per run map with :func:`torch.func.vmap` and ``randomness="same"``.

    Args:
        latents: Shape ``(*B, D)``; all leading dimensions are one set of samples.
        mask: Boolean, shape ``(*B)`` or ``(*B, 1)``; ``False`` marks a row that does not count.
        num_slices: Number :math:`S` of random directions, drawn anew by each call.
        num_points: Number :math:`P` of points on :math:`[0, 5]`, where the integrand is evaluated.
        generator: Source of the directions, on the device of the latents; the global one if ``None``.

    Returns:
        A scalar, at least 0; 0 if no row is left. NaN if a latent that counts is NaN or infinite.

    Raises:
        ValueError: If ``num_slices`` or ``num_points`` is too small, or for the shapes that
            :func:`masked_moments` refuses.
        TypeError: For the dtypes that :func:`masked_moments` refuses.

    Examples:
        >>> import torch
        >>> generator = torch.Generator().manual_seed(0)
        >>> latents = torch.randn(1000, 16, generator=generator)
        >>> sliced_gaussian_distance(latents, generator=generator) < 2e-3
        tensor(True)
        >>> round(sliced_gaussian_distance(torch.zeros(1000, 16)).item(), 3)
        0.163
    """
    for name, value, least in (("num_slices", num_slices, 1), ("num_points", num_points, 2)):
        if value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}.")
    x, mask = _as_rows(latents, mask)
    return row_distance(x, mask, num_slices=num_slices, num_points=num_points, generator=generator)


def row_distance(
    x: Tensor,
    mask: Tensor | None = None,
    *,
    num_slices: int = 64,
    num_points: int = 17,
    generator: torch.Generator | None = None,
) -> Tensor:
    """:func:`sliced_gaussian_distance` of several sets of rows at once, with the same directions.

    Args:
        x: Shape ``(*N, R, D)``, at least float32.
        mask: Boolean, shape ``(R,)`` or ``(*N, R)``; ``False`` marks a row that does not count.
        num_slices: See :func:`sliced_gaussian_distance`.
        num_points: See :func:`sliced_gaussian_distance`.
        generator: See :func:`sliced_gaussian_distance`.

    Returns:
        Shape ``(*N)``.

    Examples:
        >>> import torch
        >>> row_distance(torch.zeros(2, 100, 3)).shape
        torch.Size([2])
    """
    with torch.autocast(device_type=x.device.type, enabled=False):
        directions = torch.randn(x.shape[-1], num_slices, generator=generator, dtype=x.dtype, device=x.device)
        directions = directions / directions.norm(dim=0)
        t = torch.linspace(0, 5, num_points, dtype=x.dtype, device=x.device)
        step = 5 / (num_points - 1)
        gaussian = torch.exp(-0.5 * t.square())
        # Twice the half-line: the integrand is even. It vanishes at both ends, so they need no halving.
        weight = 2 * step / math.sqrt(2 * math.pi) * gaussian
        if mask is not None:
            x = torch.where(mask.unsqueeze(-1), x, 0)
        angle = (x @ directions).unsqueeze(-1) * t  # (*N, R, S, P)
        if mask is None:
            real, imaginary = angle.cos().mean(-3), angle.sin().mean(-3)
            return (((real - gaussian).square() + imaginary.square()) @ weight).mean(-1)
        count = mask.sum(-1, keepdim=True).to(x.dtype)
        row = (mask.to(x.dtype) / count.clamp(min=1))[..., None, None]
        real, imaginary = (row * angle.cos()).sum(-3), (row * angle.sin()).sum(-3)
        distance = (((real - gaussian).square() + imaginary.square()) @ weight).mean(-1)
        return torch.where(count.squeeze(-1) > 0, distance, 0)


def _as_rows(x: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Check and flatten samples to ``(R, D)`` (at least float32) and the mask to ``(R,)``."""
    if not x.is_floating_point():
        raise TypeError(f"Samples must be floating point, got {x.dtype}; cast them first.")
    if x.ndim == 0 or x.shape[-1] == 0 or x.numel() == 0:
        raise ValueError(
            f"Samples must have shape (*B, D) with at least one row and one feature, got {tuple(x.shape)}."
        )
    batch = x.shape[:-1]
    if mask is not None:
        if mask.dtype is not torch.bool:
            raise TypeError(f"mask must be boolean (False marks rows that do not count), got {mask.dtype}.")
        if mask.shape not in (batch, (*batch, 1)):
            raise ValueError(
                f"mask must have shape {tuple(batch)} or {(*batch, 1)} to fit samples of shape "
                f"{tuple(x.shape)}, got {tuple(mask.shape)}."
            )
        mask = mask.reshape(-1)
    if x.dtype in (torch.float16, torch.bfloat16):
        x = x.float()
    return x.reshape(-1, x.shape[-1]), mask
