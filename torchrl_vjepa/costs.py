r"""Costs over latents and actions, and a quadratic reward head.

A cost is a callable ``(latent (*B, D), action (*B, A)) -> (*B)``, lower is better. Planning calls
it with the *next* latent :math:`Z_{t+k+1}` and the action :math:`u_{t+k}` that led to it, as in
``eq:latent_mpc_objective``; all steps of a horizon come in one block, as batch dimensions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchrl_vjepa.priors import Prior, Task

__all__ = [
    "Cost",
    "QuadraticReward",
    "StageCost",
    "action_cost",
    "prior_cost",
    "quadratic_cost",
]

StageCost = Callable[[Tensor, Tensor], Tensor]


class Cost(nn.Module):
    r"""A cost that can be added to others and scaled: ``quadratic_cost(g) + 0.1 * action_cost()``.

    A subclass gives ``forward(latent (*B, D), action (*B, A)) -> (*B)``. Anything callable with
    that signature can be an addend.

    Examples:
        >>> import torch
        >>> total = quadratic_cost(torch.zeros(2)) + 0.5 * action_cost()
        >>> total(torch.ones(1, 2), torch.ones(1, 4))
        tensor([4.])
    """

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        """Cost of arriving at ``latent`` by ``action``.

        Args:
            latent: next latent, of shape ``(*B, D)``.
            action: action that led there, of shape ``(*B, A)``.

        Returns:
            Costs of shape ``(*B)``.

        Raises:
            NotImplementedError: by this base class.
        """
        raise NotImplementedError

    def __add__(self, other: StageCost) -> Cost:
        if not callable(other):
            return NotImplemented
        return _WeightedSum([(1.0, self), (1.0, other)])

    def __radd__(self, other: StageCost | int) -> Cost:
        if isinstance(other, int) and other == 0:  # the start of the built-in sum()
            return self
        if not callable(other):
            return NotImplemented
        return _WeightedSum([(1.0, other), (1.0, self)])

    def __mul__(self, factor: float) -> Cost:
        if not isinstance(factor, (int, float)):
            return NotImplemented
        return _WeightedSum([(float(factor), self)])

    __rmul__ = __mul__


class _FunctionCost(Cost):
    """A plain function as a module, so that a sum holds one kind of thing."""

    def __init__(self, function: StageCost) -> None:
        super().__init__()
        self.function = function

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        return self.function(latent, action)


class _WeightedSum(Cost):
    """Weighted sum of costs."""

    def __init__(self, terms: list[tuple[float, StageCost]]) -> None:
        super().__init__()
        self.factors: list[float] = []
        self.terms = nn.ModuleList()
        for factor, term in terms:
            if isinstance(term, _WeightedSum):
                self.factors += [factor * inner for inner in term.factors]
                self.terms.extend(term.terms)
            else:
                self.factors.append(factor)
                self.terms.append(term if isinstance(term, nn.Module) else _FunctionCost(term))

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        total: Any = None
        for factor, term in zip(self.factors, self.terms, strict=True):
            value = term(latent, action)
            if total is None:
                total = value if factor == 1.0 else factor * value
            else:
                total = torch.add(total, value, alpha=factor)
        return total


def _quadratic_form(value: Tensor, weight: Tensor) -> Tensor:
    """``v^T W v`` over the last dimension; ``W`` a number, a diagonal, or a matrix."""
    if weight.ndim == 2:
        return ((value @ weight) * value).sum(dim=-1)
    return _weighted_squares(value.square(), weight)


def _weighted_squares(squares: Tensor, weight: Tensor) -> Tensor:
    """Sum over the last dimension, weighted by a number or a diagonal."""
    size = squares.shape[-1]
    number = weight.ndim == 0  # which takes the dtype of what it multiplies
    if size <= 16 and (number or weight.dtype == squares.dtype):
        # torch sums short rows several times more slowly than it multiplies them.
        weight = weight.to(squares.dtype).expand(size)
        return squares.reshape(-1, size).mv(weight).view(squares.shape[:-1])
    if number:
        return weight * squares.sum(dim=-1)
    return (squares * weight).sum(dim=-1)


def _checked_weight(weight: Tensor | float | None, size: int | None) -> Tensor:
    weight = torch.as_tensor(1.0 if weight is None else weight).detach().clone()
    if not weight.is_floating_point():
        weight = weight.to(torch.get_default_dtype())
    shapes = [(), (size,), (size, size)]
    square = weight.ndim < 2 or (weight.ndim == 2 and weight.shape[0] == weight.shape[1])
    if (size is not None and tuple(weight.shape) not in shapes) or not square:
        raise ValueError(
            "weight must be a number, a vector (n,) or a square matrix (n, n)"
            f"{'' if size is None else f' with n={size}'}, got shape {tuple(weight.shape)}"
        )
    if not bool(weight.isfinite().all()):
        raise ValueError(f"weight must be finite, got {weight.tolist()}")
    if weight.ndim == 2:
        weight = 0.5 * (weight + weight.mT)
        smallest = torch.linalg.eigvalsh(weight).min()
        negative = bool(smallest < -1e-6 * weight.abs().max())
    else:
        negative = bool((weight < 0).any())
    if negative:
        raise ValueError(
            f"weight must be positive semi-definite (else the cost has no minimum), got {weight.tolist()}"
        )
    return weight


class _QuadraticCost(Cost):
    target: Tensor
    weight: Tensor

    def __init__(self, target: Tensor, weight: Tensor) -> None:
        super().__init__()
        self.register_buffer("target", target)
        self.register_buffer("weight", weight)

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        error, weight = latent - self.target, self.weight
        if weight.ndim == 2:
            return _quadratic_form(error, weight)
        return _weighted_squares(error.square_(), weight)


class _ActionCost(Cost):
    weight: Tensor

    def __init__(self, weight: Tensor) -> None:
        super().__init__()
        self.register_buffer("weight", weight)

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        return _quadratic_form(action, self.weight)


class _PriorCost(Cost):
    def __init__(self, prior: Prior) -> None:
        super().__init__()
        self.prior = prior

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        return self.prior.energy(latent)


def prior_cost(prior: Prior, task: Task = None) -> Cost:
    r"""Energy of a prior as a cost, :math:`E(Z; \eta) = -\log p_{\text{prior}}(Z \mid \eta)`.

    For scaled sums of energies whose tasks are fixed; tasks that change, by row or by step, are given to
    ``LatentEnv(prior=...)``, which reads them from the tensordict.

    Args:
        prior: the prior.
        task: :math:`\eta`, for a prior that takes one.

    Returns:
        The cost, in nats; it does not look at the action.

    Raises:
        ValueError: if the prior takes a task and there is none.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import GaussianPrior
        >>> cost = prior_cost(GaussianPrior(2)) + 0.1 * action_cost()
        >>> cost(torch.zeros(3, 2), torch.zeros(3, 1)).shape
        torch.Size([3])
    """
    if task is None and prior.in_keys:
        raise ValueError(
            f"task must be given for a prior that reads {prior.in_keys}, got None; or give the prior to "
            "LatentEnv, which reads tasks from the tensordict"
        )
    return _PriorCost(prior if task is None else prior.bind(task))


def quadratic_cost(target: Tensor, weight: Tensor | float | None = None) -> Cost:
    r"""Weighted squared distance of the latent to a target, :math:`(z - g)^\top W (z - g)`.

    Args:
        target: :math:`g`, of shape ``(D,)``.
        weight: :math:`W`: ``None`` (identity), a number, a diagonal ``(D,)``, or a matrix
            ``(D, D)`` of which the symmetric part counts; positive semi-definite.

    Returns:
        The cost; ``target`` and ``weight`` are buffers, so ``.to(device)`` moves them.

    Raises:
        ValueError: if ``target`` is no finite vector, or ``weight`` has another size or is not
            positive semi-definite.

    Examples:
        >>> import torch
        >>> cost = quadratic_cost(torch.tensor([1.0, 0.0]), weight=torch.tensor([2.0, 1.0]))
        >>> cost(torch.tensor([[1.0, 0.0], [2.0, 3.0]]), torch.zeros(2, 1))
        tensor([ 0., 11.])
    """
    target = torch.as_tensor(target).detach().clone()
    if not target.is_floating_point():
        target = target.to(torch.get_default_dtype())
    if target.ndim != 1:
        raise ValueError(f"target must have shape (D,), got {tuple(target.shape)}")
    if not bool(target.isfinite().all()):
        raise ValueError(f"target must be finite, got {target.tolist()}")
    checked = _checked_weight(weight, target.shape[-1])
    return _QuadraticCost(target, checked.to(target.dtype))


def action_cost(weight: Tensor | float = 1.0) -> Cost:
    r"""Effort, :math:`u^\top W u`.

    Args:
        weight: :math:`W`: a number, a diagonal ``(A,)``, or a matrix ``(A, A)`` of which the
            symmetric part counts; positive semi-definite.

    Returns:
        The cost; it does not look at the latent.

    Raises:
        ValueError: if ``weight`` is not square, not finite, or not positive semi-definite.

    Examples:
        >>> import torch
        >>> action_cost(0.1)(torch.zeros(1, 3), torch.tensor([[1.0, 2.0]]))
        tensor([0.5000])
    """
    return _ActionCost(_checked_weight(weight, None))


class QuadraticReward(nn.Module):
    r"""Reward head: a full quadratic form of latent and action.

    With :math:`y = [z, u]`, :math:`r = b + l^\top y + y^\top Q y`, :math:`Q` symmetric and held by
    its upper triangle. Every reward that is quadratic in state and action is of this form in every
    linear latent, and squared error is convex in the parameters. They start at zero.

    For TorchRL: ``TensorDictModule(QuadraticReward(D, A), ["latent", "action"], ["reward"])``.

    Args:
        latent_dim: size ``D`` of the latent.
        action_dim: size ``A`` of the action; 0 for a reward of the latent alone.

    Raises:
        ValueError: if a size is not valid.

    Examples:
        >>> import torch
        >>> reward = QuadraticReward(latent_dim=4, action_dim=2)
        >>> reward(torch.ones(7, 4), torch.ones(7, 2)).shape
        torch.Size([7, 1])
    """

    triangle_index: Tensor

    def __init__(self, latent_dim: int, action_dim: int) -> None:
        super().__init__()
        if latent_dim < 1 or action_dim < 0:
            raise ValueError(
                f"latent_dim must be positive and action_dim at least 0, got {latent_dim} and {action_dim}"
            )
        self.latent_dim = latent_dim
        self.action_dim = action_dim
        size = latent_dim + action_dim
        rows, columns = torch.triu_indices(size, size)
        index = torch.zeros(size, size, dtype=torch.long)
        index[rows, columns] = torch.arange(len(rows))
        index[columns, rows] = torch.arange(len(rows))
        # Row i, column j of Q is triangle[index[i, j]]: one gather, which vmap and compile follow.
        self.register_buffer("triangle_index", index, persistent=False)
        self.bias = nn.Parameter(torch.zeros(1))
        self.linear = nn.Parameter(torch.zeros(size))
        self.triangle = nn.Parameter(torch.zeros(len(rows)))

    def reset_parameters(self) -> None:
        """Back to the reward that is zero everywhere."""
        with torch.no_grad():
            for parameter in self.parameters():
                parameter.zero_()

    @property
    def matrix(self) -> Tensor:
        """The symmetric matrix :math:`Q`, of shape ``(D + A, D + A)``."""
        return self.triangle[self.triangle_index]

    def forward(self, latent: Tensor, action: Tensor | None = None) -> Tensor:
        """Predicted reward.

        Args:
            latent: of shape ``(*B, D)``.
            action: of shape ``(*B, A)``; ``None`` if ``action_dim`` is 0.

        Returns:
            Rewards of shape ``(*B, 1)``.

        Raises:
            ValueError: if a shape does not fit.
        """
        expected = (*latent.shape[:-1], self.action_dim)
        fits = (
            action is None
            if self.action_dim == 0
            else (action is not None and tuple(action.shape) == expected)
        )
        if latent.shape[-1] != self.latent_dim or not fits:
            raise ValueError(
                f"latent and action must have shapes (*B, {self.latent_dim}) and "
                f"(*B, {self.action_dim}), got {tuple(latent.shape)} and "
                f"{None if action is None else tuple(action.shape)}"
            )
        y = latent if action is None else torch.cat([latent, action], dim=-1)
        # b + y . (l + Q y): one matrix product and one reduction.
        return self.bias + (F.linear(y, self.matrix, self.linear) * y).sum(dim=-1, keepdim=True)
