"""Draws from a generator of one's own, and draws that share their random numbers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, MultivariateNormal, Normal

from torchrl_vjepa.distributions.delta import Delta
from torchrl_vjepa.distributions.noise import NoiseDistribution

__all__ = ["from_noise", "noise_dim", "sample"]


def noise_dim(p: Distribution) -> int | None:
    """How many standard normal numbers a draw of ``p`` takes.

    Args:
        p: the distribution, event ``(D,)``.

    Returns:
        The number, 0 for a point; ``None`` for a distribution that is not known as a transform of
        normal noise.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> noise_dim(diag_gaussian(torch.zeros(5, 3), torch.ones(3))), noise_dim(Delta(torch.zeros(3)))
        (3, 0)
    """
    if isinstance(p, NoiseDistribution):
        return p.noise_dim
    if isinstance(p, Delta):
        return 0
    if isinstance(p, MultivariateNormal) or (isinstance(p, Independent) and isinstance(p.base_dist, Normal)):
        return p.event_shape[-1]
    return None


def from_noise(p: Distribution, noise: Tensor) -> Tensor:
    r"""The draws :math:`Z = T(\epsilon)` that standard normal noise becomes, with gradients.

    Two distributions that are given the same noise have common random numbers.

    Args:
        p: the distribution, batch ``*B`` and event ``(D,)``.
        noise: of shape ``(*S, *B, noise_dim(p))``, or broadcastable to it.

    Returns:
        Latents of shape ``(*S, *B, D)``.

    Raises:
        TypeError: if ``p`` is no known transform of normal noise.
        ValueError: if the last dimension of ``noise`` does not fit.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> p = diag_gaussian(torch.zeros(2, 3), torch.full((3,), 0.5))
        >>> from_noise(p, torch.ones(7, 1, 3)).shape
        torch.Size([7, 2, 3])
    """
    size = noise_dim(p)
    if size is None:
        raise TypeError(f"p must be a transform of normal noise, got {type(p).__name__}; use sample")
    if noise.shape[-1:] != (size,):
        raise ValueError(f"noise must have shape (*S, *B, {size}), got {tuple(noise.shape)}")
    if isinstance(p, NoiseDistribution):
        return p.from_noise(noise)
    if isinstance(p, Delta):
        shape = torch.broadcast_shapes(noise.shape[:-1], p.batch_shape)
        return p.mean.expand(*shape, *p.event_shape)
    if isinstance(p, MultivariateNormal):
        return p.loc + (p._unbroadcasted_scale_tril @ noise.unsqueeze(-1)).squeeze(-1)
    return p.mean + p.stddev * noise


def sample(
    p: Distribution,
    sample_shape: Sequence[int] = (),
    *,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Draw :math:`Z^{(m)} \sim p` (``eq:vjepa_predictive_model``) from a generator of one's own.

    ``torch.distributions`` can only read the global random state; with a ``generator`` this function
    leaves it untouched.

    Args:
        p: the distribution, batch ``*B`` and event ``(D,)``.
        sample_shape: leading dimensions of independent samples.
        generator: source of randomness, on the device of ``p``; the global one if ``None``.

    Returns:
        Samples of shape ``(*sample_shape, *B, D)``, without gradient.

    Raises:
        ValueError: if ``generator`` is on another device than ``p``.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> p = diag_gaussian(torch.zeros(2), torch.ones(2))
        >>> a = sample(p, (3,), generator=torch.Generator().manual_seed(0))
        >>> b = sample(p, (3,), generator=torch.Generator().manual_seed(0))
        >>> a.shape, torch.equal(a, b)
        (torch.Size([3, 2]), True)
    """
    shape = torch.Size(sample_shape)
    if generator is None or isinstance(p, Delta):
        return p.sample(shape)
    with torch.no_grad():
        size = noise_dim(p)
        if size is not None:
            like = p if isinstance(p, NoiseDistribution) else p.mean
            _check_device(generator, like.device)
            noise_shape = (*shape, *p.batch_shape, size)
            noise = torch.randn(noise_shape, generator=generator, device=like.device, dtype=like.dtype)
            return from_noise(p, noise)
        device = generator.device
        seed = int(torch.randint(2**62, (), generator=generator, device=device))
        # torch.manual_seed would seed every device, also those that are not restored.
        if device.type == "cpu":
            with torch.random.fork_rng(devices=[]):
                torch.default_generator.manual_seed(seed)
                draw = p.sample(shape)
        else:
            module = torch.get_device_module(device)
            with (
                torch.random.fork_rng(devices=[device], device_type=device.type),
                module.device(device),
            ):
                module.manual_seed(seed)
                draw = p.sample(shape)
        _check_device(generator, draw.device)
        return draw


def _check_device(generator: torch.Generator, device: torch.device) -> None:
    if generator.device.type != device.type:
        raise ValueError(
            f"generator must be on the device of the distribution, {device}, got "
            f"{generator.device}; make it with torch.Generator({device.type!r})"
        )
