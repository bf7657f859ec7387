"""The planners' arithmetic as hand-written loops: what a planner costs without a library."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

MIN_STD, TEMPERATURE = 0.01, 0.5


@dataclass
class Floor:
    """One network, one cost, one planner: no checks, nothing that the plan does not need.

    The skip's one-hot input is folded into the bias, the half of the last layer that predicts the variance
    is left out, activations are in place, and every step writes into the same buffers.
    """

    layers: list[tuple[Tensor, Tensor]]  # weight (out, in), bias (out)
    goal: Tensor  # (D)
    effort: float
    bound: float
    action_dim: int
    horizon: int
    candidates: int
    iterations: int
    top_k: int
    kind: Literal["cem", "mppi"]

    def costs(self, start: Tensor, actions: Tensor) -> Tensor:
        """Costs ``(B, N)`` of plans ``(B, N, H, A)`` from latents ``(B, D)``."""
        batch, num, horizon, _ = actions.shape
        (w1, b1), (w2, b2), (w3, b3) = ((weight.T, bias) for weight, bias in self.layers)
        rows = actions.view(batch * num, horizon, -1)
        latent = start.unsqueeze(1).expand(-1, num, -1).reshape(batch * num, -1)
        latents = latent.new_empty(horizon, *latent.shape)
        joined = latent.new_empty(len(latent), w1.shape[0])
        first, second = (latent.new_empty(len(latent), w.shape[1]) for w in (w1, w2))
        for action, following in zip(rows.unbind(1), latents.unbind(0), strict=True):
            torch.cat([latent, action], 1, out=joined)
            torch.addmm(b1, joined, w1, out=first)
            F.silu(first, inplace=True)
            torch.addmm(b2, first, w2, out=second)
            F.silu(second, inplace=True)
            latent = torch.addmm(b3, second, w3, out=following)
        distance = latents.sub_(self.goal).square_().sum((0, 2))
        effort = rows.square().sum((1, 2))
        return distance.add_(effort, alpha=self.effort).view(batch, num)

    def plan(self, start: Tensor, generator: torch.Generator) -> Tensor:
        """Plans ``(B, H, A)``."""
        batch, shape = len(start), (self.horizon, self.action_dim)
        cold = 0.5 * self.bound
        mean = start.new_zeros(batch, *shape)
        std = start.new_full((batch, *shape), cold)
        best, best_cost = mean, start.new_full((batch,), torch.inf)
        for _ in range(self.iterations):
            half = torch.randn(self.candidates // 2, *shape, generator=generator)
            noise = torch.cat([half, -half])
            actions = torch.addcmul(mean.unsqueeze(1), std.unsqueeze(1), noise)
            actions.clamp_(-self.bound, self.bound)
            actions[:, 0] = mean
            actions[:, 1] = best
            costs, index = self.costs(start, actions).topk(self.top_k, dim=1, largest=False)
            elites = actions.gather(1, index[..., None, None].expand(-1, -1, *shape))
            better = costs[:, 0] < best_cost
            best = torch.where(better[:, None, None], elites[:, 0], best)
            best_cost = torch.where(better, costs[:, 0], best_cost)
            if self.kind == "cem":
                weights = costs.new_full((batch, 1, self.top_k), 1 / self.top_k)
            else:
                spread = costs.std(1, correction=0, keepdim=True)
                weights = (-costs / (TEMPERATURE * spread)).softmax(1).unsqueeze(1)
            flat = elites.flatten(2)
            squares = (elites - mean.unsqueeze(1)).square_().flatten(2)
            std = torch.bmm(weights, squares).sqrt_().clamp_(MIN_STD * cold, cold).view(batch, *shape)
            mean = torch.bmm(weights, flat).clamp_(-self.bound, self.bound).view(batch, *shape)
        return mean

    def products(self, start: Tensor, inputs: Tensor) -> Tensor:
        """The matrix products of a plan alone, on inputs ``(B N, D + A)`` that stay the same."""
        weights = [weight.T for weight, _ in self.layers]
        for _ in range(self.iterations * self.horizon):
            out = inputs
            for weight in weights:
                out = out @ weight
        return out
