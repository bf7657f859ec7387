"""What planners draw plans from, and where it starts: Gaussian for numbers, categorical for choices."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchrl_vjepa.actions import ActionCodec

__all__ = ["Proposal", "ProposalFamily"]


class Proposal(NamedTuple):
    """A distribution over action sequences, in the code of :class:`~torchrl_vjepa.actions.ActionCodec`.

    Independent in each step and number: Gaussian where actions are continuous, in their units. In a block of
    ``n`` choices the mean is their categorical distribution, of a bit its probability, and the standard
    deviation follows from them.

    Attributes:
        mean: of shape ``(*B, H, A)``, inside the bounds.
        std: of shape ``(*B, H, A)``; positive, zero at most where a choice is forbidden or certain.

    Examples:
        >>> import torch
        >>> Proposal(torch.zeros(5, 2), torch.ones(5, 2)).mean.shape
        torch.Size([5, 2])
    """

    mean: Tensor
    std: Tensor


class ProposalFamily(nn.Module):
    r"""The proposals over one action specification: how they start, stay valid and are drawn from.

    **One rule for all actions.** The mean of elites that are one-hot *is* a categorical distribution, so the
    cross-entropy method over choices is the cross-entropy method over their codes.

    **Draws come from standard normal noise.** Where actions are continuous it is scaled and shifted; a
    choice is the quantile of its distribution at :math:`\Phi(\varepsilon)` (a Gaussian copula). So noise in
    antithetic pairs, or correlated in time, is that for choices too.

    Args:
        codec: of the actions.
        init_std: spread after a cold start of continuous actions: a fraction of half the range where the
            action is bounded (0.5 by default), in units of the action where it is not (no default).

    Attributes:
        centre: the mean that knows nothing, ``(A)``: the middle of the bounds, uniform over choices.
        cold_std: its standard deviation, ``(A)``.
        noise_dim: numbers of noise in one step of a plan: one for each number, bit and block.

    Raises:
        ValueError: if bounds are degenerate, or ``init_std`` is missing.

    Examples:
        >>> import torch
        >>> from torchrl.data import Bounded, Categorical, Composite
        >>> codec = ActionCodec(Composite(gear=Categorical(4), wheel=Bounded(0, 4, (1,))))
        >>> family = ProposalFamily(codec)
        >>> family.centre
        tensor([0.2500, 0.2500, 0.2500, 0.2500, 2.0000])
        >>> family.draw(family.cold((), 1), torch.tensor([[[-9.0, 1.0]]]))  # N = 1 plan of H = 1 step
        tensor([[[1., 0., 0., 0., 3.]]])
    """

    low: Tensor
    high: Tensor
    centre: Tensor
    cold_std: Tensor
    source: Tensor
    block_source: Tensor

    def __init__(self, codec: ActionCodec, init_std: float | None = None) -> None:
        super().__init__()
        self.codec = codec
        low, high = codec.low.clone(), codec.high.clone()
        limit = 0.5 * torch.finfo(low.dtype).max  # Unbounded has the largest number as its bound
        bounded = (low > -limit) & (high < limit)
        if bool((~(low < high)).any()):
            raise ValueError(
                f"action bounds must satisfy low < high, got low={low.tolist()} and high={high.tolist()}"
            )
        if init_std is None and not bool(bounded.all()):
            raise ValueError(
                "init_std must be given, in units of the action, for an action without finite bounds, "
                f"got None with low={low.tolist()} and high={high.tolist()}"
            )
        half_range = torch.where(bounded, 0.5 * high - 0.5 * low, 1.0)
        centre = torch.where(bounded, 0.5 * high + 0.5 * low, torch.zeros_like(low).clamp(low, high))
        std = half_range * (0.5 if init_std is None else init_std)
        if not codec.is_continuous:
            uniform = self._normalised(torch.ones_like(centre))
            centre = torch.where(codec.is_choice, uniform, centre)
            std = torch.where(codec.is_choice | codec.is_bit, (centre * (1 - centre)).sqrt(), std)
        first = ~codec.is_choice | (codec.choice == 0)
        source = first.long().cumsum(0) - 1
        self.noise_dim = int(first.sum())
        tensors = {"low": low, "high": high, "centre": centre, "cold_std": std}
        tensors |= {"source": source, "block_source": source[codec.is_choice & first]}
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor, persistent=False)

    def cold(self, batch: tuple[int, ...], horizon: int) -> Proposal:
        """The proposal that knows nothing.

        Args:
            batch: ``*B``.
            horizon: ``H``.

        Returns:
            The proposal, expanded.
        """
        shape = (*batch, horizon, self.codec.size)
        return Proposal(self.centre.expand(shape), self.cold_std.expand(shape))

    def around(self, plan: Tensor, spread: float) -> Proposal:
        """The proposal that starts from a plan.

        Args:
            plan: finite, of shape ``(*B, H, A)``; put inside the bounds first.
            spread: of numbers, as a fraction of the one after a cold start; and the probability with which
                a choice is not the plan's, but drawn from all.

        Returns:
            The proposal.
        """
        mean = plan.clamp(self.low, self.high)
        std = (spread * self.cold_std).expand(mean.shape)
        if self.codec.is_continuous:
            return Proposal(mean, std)
        mixed = (1 - spread) * self._normalised(mean) + spread * self.centre
        return self._discrete(torch.where(self.codec.is_choice | self.codec.is_bit, mixed, mean), std)

    def confinement(self, floor: float) -> Callable[[Proposal], Proposal]:
        """The nearest proposal inside the bounds, of a spread between a floor and that of a cold start.

        Args:
            floor: of numbers, as a fraction of the cold spread; and the weight of the uniform distribution
                that the one over choices contains at least, so that none is ever ruled out.

        Returns:
            Takes a finite proposal of shape ``(*B, H, A)`` to the nearest; one that is inside already stays
            as it is.
        """
        codec, low, high, cold_std = self.codec, self.low, self.high, self.cold_std
        least_std = floor * cold_std

        def confine(proposal: Proposal) -> Proposal:
            mean = proposal.mean.clamp(low, high)
            std = proposal.std.clamp(least_std, cold_std)
            if codec.is_continuous:
                return Proposal(mean, std)
            excess = (self._normalised(mean) - floor * self.centre).clamp_min(0)
            choice = floor * self.centre + (1 - floor) * self._normalised(excess)
            mean = torch.where(codec.is_choice, choice, mean)
            mean = torch.where(codec.is_bit, mean.clamp(0.5 * floor, 1 - 0.5 * floor), mean)
            return self._discrete(mean, std)

        return confine

    def draw(self, proposal: Proposal, noise: Tensor) -> Tensor:
        """Plans, as exact codes inside the bounds.

        Args:
            proposal: of shape ``(*B, H, A)``.
            noise: standard normal, of shape ``(N, H, noise_dim)``: the same for all rows.

        Returns:
            Of shape ``(*B, N, H, A)``.
        """
        mean, std = proposal.mean.unsqueeze(-3), proposal.std.unsqueeze(-3)
        codec = self.codec
        if codec.is_continuous:
            return torch.addcmul(mean, std, noise).clamp_(self.low, self.high)
        drawn = torch.addcmul(mean, std, noise[..., self.source]).clamp_(self.low, self.high)
        # Below one, so that the last choice is drawn only where it has a probability.
        quantile = torch.special.ndtr(noise).clamp_max(1 - torch.finfo(noise.dtype).eps)
        drawn = torch.where(codec.is_bit, (quantile[..., self.source] < mean).to(drawn.dtype), drawn)
        if not codec.members.shape[0]:
            return drawn
        weights = mean[..., codec.members].masked_fill(codec.forbidden, 0.0)
        cumulative = weights.cumsum(dim=-1)
        cumulative = cumulative / cumulative[..., -1:]
        below = quantile[..., self.block_source].unsqueeze(-1) >= cumulative[..., :-1]
        return codec.with_choices(drawn, below.sum(dim=-1))

    def _discrete(self, mean: Tensor, std: Tensor) -> Proposal:
        discrete = self.codec.is_choice | self.codec.is_bit
        return Proposal(mean, torch.where(discrete, (mean * (1 - mean)).clamp_min(0).sqrt(), std))

    def _normalised(self, weights: Tensor) -> Tensor:
        """Weights of the allowed choices that sum to one in each block; uniform where all are zero."""
        codec = self.codec
        if not codec.members.shape[0]:
            return weights
        weights = torch.where(codec.allowed, weights, 0.0)
        total = weights[..., codec.members].masked_fill(codec.forbidden, 0.0).sum(dim=-1)[..., codec.block]
        allowed = (~codec.forbidden).to(weights.dtype)
        uniform = (allowed / allowed.sum(dim=-1, keepdim=True))[codec.block, codec.choice]
        share = weights / total.clamp_min(torch.finfo(weights.dtype).tiny)
        return torch.where(codec.is_choice, torch.where(total > 0, share, uniform), weights)
