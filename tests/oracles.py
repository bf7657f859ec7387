"""Slow, obvious or closed-form versions of what the library computes fast."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


def linear_gaussian_moments(
    a: Tensor, b: Tensor, noise: Tensor, start: Tensor, actions: Tensor
) -> tuple[Tensor, Tensor]:
    """Mean (H, D) and covariance (H, D, D) of z' = a z + b u + w, w ~ N(0, noise), by matrix powers."""
    means, covariances = [], []
    for h in range(1, len(actions) + 1):
        powers = [torch.linalg.matrix_power(a, k) for k in range(h + 1)]
        driven = sum(powers[h - 1 - i] @ b @ actions[i] for i in range(h))
        means.append(powers[h] @ start + driven)
        covariances.append(sum(powers[k] @ noise @ powers[k].mT for k in range(h)))
    return torch.stack(means), torch.stack(covariances)


def reduced_rank_error(x: Tensor, u: Tensor, y: Tensor, rank: int) -> Tensor:
    """Minimum over V (O, rank), W (rank, O), G (O, A) of the mean of |y - V W x - G u|^2.

    By the theorem of Frisch, Waugh and Lovell u is regressed out of both sides; the rest is reduced-rank
    regression, whose optimum keeps the leading principal directions of the fitted values.
    """

    def without_u(value: Tensor) -> Tensor:
        return value - u @ torch.linalg.lstsq(u, value).solution

    x, y = without_u(x), without_u(y)
    fitted = x @ torch.linalg.lstsq(x, y).solution
    explained = torch.linalg.svdvals(fitted)[:rank].pow(2).sum()
    return (y.pow(2).sum() - explained) / len(y)


def pairs_that_count(
    done: Sequence[bool], is_init: Sequence[bool], mask: Sequence[bool], skip: int
) -> list[bool]:
    """For each t: no end in t..t+skip-1, no beginning in t+1..t+skip, no padding in t..t+skip."""
    count = []
    for t in range(len(done) - skip):
        good = True
        for s in range(t, t + skip):
            good = good and not done[s]
        for s in range(t + 1, t + skip + 1):
            good = good and not is_init[s]
        for s in range(t, t + skip + 1):
            good = good and bool(mask[s])
        count.append(good)
    return count


INTEGRATION_GRID = torch.linspace(-12.0, 12.0, 24001, dtype=torch.float64)


def product_integrals(p: Any, prior: Any) -> tuple[float, float, float]:
    """Log of the integral of p times prior, and mean and variance of the product, in one dimension."""
    z = INTEGRATION_GRID.unsqueeze(-1)
    mass = (p.log_prob(z) + prior.log_prob(z)).exp() * (INTEGRATION_GRID[1] - INTEGRATION_GRID[0])
    mean = (mass * INTEGRATION_GRID).sum() / mass.sum()
    variance = (mass * (INTEGRATION_GRID - mean) ** 2).sum() / mass.sum()
    return float(mass.sum().log()), float(mean), float(variance)
