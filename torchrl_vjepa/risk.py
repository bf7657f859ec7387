r"""Risk functionals of trajectory costs, and chance constraints.

A risk is a callable ``(costs (M, *B)) -> (*B)``, lower is better: it reads the costs of ``M`` sampled
trajectories of one plan and says what the plan is worth. Those here are functionals of the empirical
distribution of the samples, so to repeat every sample changes nothing. All but the expectation are
what the paper calls risk-sensitive (footnote to the multi-step corollary of ``thm:map_optimal``).

====================  ========  ===========  ==========  ===================================
risk                  monotone  translation  positively  limits
                                equivariant  homogeneous
====================  ========  ===========  ==========  ===================================
``expectation``       yes       yes          yes
``mean_variance(c)``  no        yes          no          ``c = 0``: the mean
``cvar(a)``           yes       yes          yes         ``a = 1``: the mean; ``a <= 1 / M``:
                                                         the worst case
``entropic(c)``       yes       yes          no          ``c -> 0``: the mean;
                                                         ``c -> inf``: the worst case
``worst_case``        yes       yes          yes
====================  ========  ===========  ==========  ===================================

A sample that is ``nan`` makes each of them ``nan``. The environments of this package go further: a
plan with one trajectory whose cost is not finite costs infinity, whatever the risk.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

__all__ = [
    "REJECTED_COST",
    "ChanceConstraint",
    "Risk",
    "Sampling",
    "cvar",
    "entropic",
    "expectation",
    "free_energy",
    "mean_variance",
    "plan_cost",
    "worst_case",
]

Risk = Callable[[Tensor], Tensor]

REJECTED_COST = 1e30
"""The least cost of a plan that a chance constraint rejects; no feasible plan may cost as much."""


def _checked(costs: Tensor) -> Tensor:
    if costs.ndim < 1 or not costs.shape[0] or not costs.is_floating_point():
        raise ValueError(
            "costs must be floating point of shape (M, *B) with at least one sample, got "
            f"{costs.dtype} of shape {tuple(costs.shape)}"
        )
    return costs


def expectation(costs: Tensor) -> Tensor:
    r"""Risk-neutral functional, the sample mean :math:`\frac1M \sum_m J^{(m)}` (``eq:latent_mpc_objective``).

    Args:
        costs: of shape ``(M, *B)``, samples first.

    Returns:
        Of shape ``(*B)``.

    Raises:
        ValueError: if there is no sample.

    Examples:
        >>> import torch
        >>> expectation(torch.tensor([[1.0], [3.0]]))
        tensor([2.])
    """
    return _checked(costs).mean(dim=0)


def worst_case(costs: Tensor) -> Tensor:
    r"""Robust functional, the largest sample :math:`\max_m J^{(m)}`.

    Where several samples tie, the gradient is split evenly between them.

    Args:
        costs: of shape ``(M, *B)``, samples first.

    Returns:
        Of shape ``(*B)``.

    Raises:
        ValueError: if there is no sample.

    Examples:
        >>> import torch
        >>> worst_case(torch.tensor([[1.0], [3.0]]))
        tensor([3.])
    """
    return _checked(costs).amax(dim=0)


def mean_variance(coeff: float) -> Risk:
    r"""Mean plus a multiple of the variance, :math:`\bar J + c\, \frac1M \sum_m (J^{(m)} - \bar J)^2`.

    For Gaussian costs it is :func:`entropic` of twice the coefficient. It is not monotone: a plan that is
    never worse can have the higher value, because it is sometimes much better.

    Args:
        coeff: :math:`c`, at least 0, in units of one over the cost.

    Returns:
        The functional, ``(costs (M, *B)) -> (*B)``.

    Raises:
        ValueError: if ``coeff`` is negative or not finite.

    Examples:
        >>> import torch
        >>> mean_variance(0.5)(torch.tensor([[1.0], [3.0]]))
        tensor([2.5000])
    """
    if not 0 <= coeff < math.inf:
        raise ValueError(f"coeff must be finite and at least 0, got {coeff}")
    return functools.partial(_mean_variance, coeff=float(coeff))


def _mean_variance(costs: Tensor, coeff: float) -> Tensor:
    mean = _checked(costs).mean(dim=0)
    return mean + coeff * (costs - mean).square().mean(dim=0)


def cvar(level: float) -> Risk:
    r"""Conditional value at risk: the mean of the worst ``level`` of the trajectories.

    With costs in descending order and :math:`a` the level,

    .. math:: \mathrm{CVaR}_a = \frac{1}{a M} \sum_{m=1}^{M} \min(1, \max(0, a M - m + 1))\, J_{(m)},

    so the sample at the edge of the tail counts by the fraction of it that lies inside: the exact value for
    the empirical distribution, equal to Rockafellar and Uryasev's
    :math:`\min_v v + \frac{1}{a M} \sum_m (J^{(m)} - v)_+`. **The level is the size of the tail**:
    ``cvar(1.0)`` is the mean, ``cvar(0.05)`` the mean of the worst twentieth (other texts call that CVaR at
    0.95). With ``level <= 1 / M`` the tail holds one sample and the value is the worst case: take at least
    ``1 / level`` samples, better ten times as many.

    Args:
        level: :math:`a`, in (0, 1].

    Returns:
        The functional, ``(costs (M, *B)) -> (*B)``.

    Raises:
        ValueError: if ``level`` is outside (0, 1].

    Examples:
        >>> import torch
        >>> costs = torch.tensor([1.0, 9.0, 5.0, 1.0])
        >>> cvar(0.25)(costs), cvar(0.375)(costs), cvar(1.0)(costs)
        (tensor(9.), tensor(7.6667), tensor(4.))
    """
    if not 0 < level <= 1:
        raise ValueError(
            f"level must be in (0, 1], the fraction of the worst trajectories that is averaged, got {level}"
        )
    return functools.partial(_cvar, level=float(level))


def _cvar(costs: Tensor, level: float) -> Tensor:
    size = level * _checked(costs).shape[0]  # of the tail, in samples
    num = min(max(1, math.ceil(size)), costs.shape[0])
    tail = costs.topk(num, dim=0).values  # nan counts as the largest
    if num == 1:
        return tail[0]
    # num - 1 whole samples and the fraction that is left, as weights that sum to one.
    return (tail[:-1].sum(dim=0) + (size - (num - 1)) * tail[-1]) / size


def entropic(risk_aversion: float) -> Risk:
    r"""Entropic risk, :math:`\frac1c \log \frac1M \sum_m e^{c J^{(m)}}`: exponential utility.

    From the mean (:math:`c \to 0`) to the worst case (:math:`c \to \infty`); :math:`\mu + \frac c2 \sigma^2`
    for Gaussian costs. The largest cost is subtracted first, so nothing overflows, and small exponents are
    summed as differences from one, so nothing cancels.

    Args:
        risk_aversion: :math:`c`, positive, in units of one over the cost.

    Returns:
        The functional, ``(costs (M, *B)) -> (*B)``.

    Raises:
        ValueError: if ``risk_aversion`` is not positive and finite.

    Examples:
        >>> import torch
        >>> costs = torch.tensor([1.0, 3.0])
        >>> entropic(1e-6)(costs), entropic(1.0)(costs), entropic(1e6)(costs)
        (tensor(2.0000), tensor(2.4338), tensor(3.0000))
    """
    if not 0 < risk_aversion < math.inf:
        raise ValueError(f"risk_aversion must be positive and finite, got {risk_aversion}")
    return functools.partial(_entropic, risk_aversion=float(risk_aversion))


def _entropic(costs: Tensor, risk_aversion: float) -> Tensor:
    # The value does not depend on what is subtracted, so neither does the gradient.
    largest = _checked(costs).detach().amax(dim=0)
    exponent = risk_aversion * (costs - largest)
    near = torch.expm1(exponent).mean(dim=0)  # above -1 / 2: exact where all exponents are small
    small = torch.log1p(near.clamp_min(-0.5))
    large = torch.logsumexp(exponent, dim=0) - math.log(costs.shape[0])
    return largest + torch.where(near > -0.5, small, large) / risk_aversion


def free_energy(costs: Tensor) -> Tensor:
    r"""Free energy, :math:`-\log \frac1M \sum_m e^{-J^{(m)}}`: minus the log-probability of success.

    Where a trajectory succeeds with probability :math:`e^{-J}`, as under a prior of energy :math:`J`, this
    is minus the log-probability that the plan does: control as inference. It is at most the mean, because
    it counts on the noise to help: :func:`entropic` with an aversion of minus one.

    Args:
        costs: of shape ``(M, *B)``, samples first, in nats.

    Returns:
        Of shape ``(*B)``.

    Raises:
        ValueError: if there is no sample.

    Examples:
        >>> import torch
        >>> free_energy(torch.tensor([[0.0], [100.0]]))  # one of two succeeds
        tensor([0.6931])
    """
    return math.log(_checked(costs).shape[0]) - torch.logsumexp(-costs, dim=0)


class ChanceConstraint(nn.Module):
    r"""A bound on the probability of a violation along the predicted belief.

    .. math:: P\big(\exists\, k < H:\ (Z_{t+k+1}, u_{t+k}) \text{ violates}\big) \le \delta,

    or, with ``joint=False``, :math:`\max_k P((Z_{t+k+1}, u_{t+k}) \text{ violates}) \le \delta`, which is
    weaker (a joint bound of :math:`\delta` follows from a bound of :math:`\delta / H` at each step).
    Probabilities are the frequencies among the ``M`` trajectories of a plan, which are multiples of
    ``1 / M``: with fewer than :math:`1 / \delta` samples no trajectory may violate.

    Without ``penalty`` a plan above the bound is **rejected**: it costs

    .. math:: 10^{30}\, (1 + e + 10^{-4} s),

    with :math:`e` the excess :math:`(\hat p - \delta)_+` (summed over the constraints that reject) and
    :math:`s` the share of violating steps in all trajectories. So every rejected plan ranks after every
    feasible one; among each other they rank by violation, and where no candidate is feasible planning still
    heads for the least violation. With ``penalty`` the cost of the plan grows by ``penalty * e`` instead.

    Args:
        violated: ``(latent (*B, D), action (*B, A)) -> (*B)``, of the next latent and the action that led
            there, as a cost is: boolean, or floating point and violating where positive (``nan`` counts as
            a violation).
        delta: :math:`\delta`, in [0, 1).
        penalty: in units of the cost, for a violation that is certain; ``None``: reject.
        joint: bound the trajectory or each step.

    Raises:
        ValueError: if ``delta`` is outside [0, 1) or ``penalty`` not positive and finite.
        TypeError: if ``violated`` is not callable.

    Examples:
        >>> import torch
        >>> def too_high(latent, action):
        ...     return latent[..., 0] > 1.0
        >>> constraint = ChanceConstraint(too_high, delta=0.1)
        >>> latents = torch.tensor([[0.0, 2.0, 2.0], [0.0, 0.0, 0.0]]).unsqueeze(-1)  # M = 2, H = 3
        >>> constraint(latents, torch.zeros(2, 3, 1))
        tensor(0.5000)
    """

    def __init__(
        self,
        violated: Callable[[Tensor, Tensor], Tensor],
        delta: float,
        *,
        penalty: float | None = None,
        joint: bool = True,
    ) -> None:
        super().__init__()
        if not callable(violated):
            raise TypeError(
                f"violated must be callable, (latent, action) -> Tensor, got {type(violated).__name__}"
            )
        if not 0 <= delta < 1:
            raise ValueError(f"delta must be in [0, 1), got {delta}")
        if penalty is not None and not 0 < penalty < math.inf:
            raise ValueError(f"penalty must be positive and finite, or None to reject, got {penalty}")
        self.violated = violated
        self.delta, self.penalty, self.joint = float(delta), penalty, joint

    def violations(self, latents: Tensor, actions: Tensor) -> Tensor:
        """Which steps of which trajectories violate.

        Args:
            latents: next latents, of shape ``(M, *B, H, D)``.
            actions: the actions that led there, of shape ``(M, *B, H, A)``.

        Returns:
            Booleans of shape ``(M, *B, H)``.

        Raises:
            ValueError: if ``violated`` returns another shape.
        """
        value = self.violated(latents, actions)
        if not isinstance(value, Tensor) or value.shape != latents.shape[:-1]:
            got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
            raise ValueError(
                f"violated must return a tensor of shape {tuple(latents.shape[:-1])} for latents "
                f"{tuple(latents.shape)}, got {got}"
            )
        return ~(value <= 0) if value.is_floating_point() else value.bool()

    def frequency(self, violations: Tensor) -> Tensor:
        """Estimated probability of a violation.

        Args:
            violations: what :meth:`violations` returned, of shape ``(M, *B, H)``.

        Returns:
            Of shape ``(*B)``: the share of trajectories that violate anywhere, or the largest share over
            the steps.
        """
        dtype = torch.get_default_dtype()
        if self.joint:
            return violations.any(dim=-1).to(dtype).mean(dim=0)
        return violations.to(dtype).mean(dim=0).amax(dim=-1)

    def forward(self, latents: Tensor, actions: Tensor) -> Tensor:
        """Estimated probability of a violation along plans.

        Args:
            latents: next latents, of shape ``(M, *B, H, D)``.
            actions: the actions that led there, of shape ``(M, *B, H, A)``.

        Returns:
            Probabilities of shape ``(*B)``.
        """
        return self.frequency(self.violations(latents, actions))

    def extra_repr(self) -> str:
        """The bound, for ``repr``.

        Returns:
            The arguments that are numbers.
        """
        return f"delta={self.delta}, penalty={self.penalty}, joint={self.joint}"


class Sampling(NamedTuple):
    """How the plans of one call are evaluated.

    Attributes:
        num_samples: trajectories ``M`` per plan; ``None``: the point prediction.
        risk: of their summed costs.
        constraints: on their latents and actions.
        fusion: how a prior enters.
        terminal_value: what a trajectory is worth behind the horizon.

    Examples:
        >>> Sampling.checked(64, cvar(0.1), ()).num_samples
        64
    """

    num_samples: int | None
    risk: Risk
    constraints: tuple[ChanceConstraint, ...]
    fusion: str = "energy"
    terminal_value: Any = None

    @classmethod
    def checked(
        cls,
        num_samples: int | None,
        risk: Risk | None,
        constraints: Sequence[ChanceConstraint],
        fusion: str = "energy",
    ) -> Sampling:
        """Refuse what cannot be evaluated.

        Args:
            num_samples: trajectories per plan; ``None``: the point prediction.
            risk: ``None``: the expectation.
            constraints: any number of them.
            fusion: how a prior enters; by posterior the risk is :func:`free_energy`.

        Returns:
            The same as a tuple.

        Raises:
            ValueError: if ``num_samples`` is not positive, a risk or constraint has no samples to read, or
                planning by posterior has none, or another risk.
            TypeError: if ``risk`` is not callable or ``constraints`` holds something else.
        """
        if num_samples is not None and (
            isinstance(num_samples, bool) or not isinstance(num_samples, int) or num_samples < 1
        ):
            raise ValueError(f"num_samples must be an integer of at least 1, got {num_samples!r}")
        if fusion not in ("energy", "weight", "propose"):
            raise ValueError(f"fusion must be 'energy', 'weight' or 'propose', got {fusion!r}")
        if fusion != "energy":
            if num_samples is None or num_samples < 2:
                raise ValueError(
                    f"num_samples must be at least 2 for fusion={fusion!r}, which reads trajectories, got "
                    f"{num_samples}; give it to the planner or, with how='sample', to LatentEnv"
                )
            if risk not in (None, free_energy):
                raise ValueError(f"risk must be None for fusion={fusion!r}, itself one, got {risk!r}")
            risk = free_energy
        if risk is not None and not callable(risk):
            raise TypeError(f"risk must be callable, (costs (M, *B)) -> (*B), got {type(risk).__name__}")
        if isinstance(constraints, ChanceConstraint) or not all(
            isinstance(constraint, ChanceConstraint) for constraint in constraints
        ):
            raise TypeError(f"constraints must be a sequence of ChanceConstraint, got {constraints!r}")
        if num_samples is None and (risk is not None or len(constraints)):
            raise ValueError(
                f"{'risk' if risk is not None else 'constraints'} must have sampled trajectories to read, "
                "got a point prediction; give num_samples to the planner, or how='sample' and num_samples "
                "to LatentEnv"
            )
        if num_samples == 1 and (risk not in (None, expectation) or len(constraints)):
            raise ValueError(
                "num_samples must be at least 2 for a risk or a constraint, which read a distribution of "
                "trajectories, got 1"
            )
        return cls(num_samples, expectation if risk is None else risk, tuple(constraints), fusion)


def plan_cost(
    costs: Tensor,
    risk: Risk = expectation,
    constraints: Sequence[ChanceConstraint] = (),
    latents: Tensor | None = None,
    actions: Tensor | None = None,
) -> Tensor:
    r"""What sampled plans are worth: the risk of their costs, penalties, and rejection.

    A plan with one trajectory whose cost is not finite costs infinity, and so ranks after all others, the
    rejected ones included.

    Args:
        costs: summed over the horizon, of shape ``(M, *B)``.
        risk: applied to them.
        constraints: on the trajectories.
        latents: next latents, of shape ``(M, *B, H, D)``; needed by constraints only.
        actions: of shape ``(M, *B, H, A)``; needed by constraints only.

    Returns:
        Of shape ``(*B)``.

    Raises:
        ValueError: if ``risk`` returns another shape, or the trajectories are missing.

    Examples:
        >>> import torch
        >>> costs = torch.tensor([[1.0, 1.0], [3.0, torch.nan]])  # M = 2 trajectories of 2 plans
        >>> plan_cost(costs, worst_case)
        tensor([3., inf])
    """
    value = risk(costs)
    if not isinstance(value, Tensor) or value.shape != costs.shape[1:]:
        got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise ValueError(
            f"risk must return a tensor of shape {tuple(costs.shape[1:])} for costs "
            f"{tuple(costs.shape)}, got {got}"
        )
    rejected = torch.zeros_like(value, dtype=torch.bool)
    order = torch.ones_like(value)
    for constraint in constraints:
        if latents is None or actions is None:
            raise ValueError("latents and actions must be given where there are constraints, got None")
        violations = constraint.violations(latents, actions)
        excess = (constraint.frequency(violations).to(value.dtype) - constraint.delta).clamp_min(0)
        # A frequency m / M is rounded: a bound that it meets exactly must not reject.
        excess = torch.where(excess > 1e-6, excess, 0.0)
        if constraint.penalty is not None:
            value = value + constraint.penalty * excess
            continue
        rejected = rejected | (excess > 0)
        order = order + excess + 1e-4 * violations.to(value.dtype).mean(dim=(0, -1))
    value = torch.where(rejected, REJECTED_COST * order, value)
    # A trajectory that is sure to fail is no fault where the logarithm of an average of chances is taken.
    sound = ~(costs.isnan() | costs.isneginf()) if risk is free_energy else costs.isfinite()
    return torch.where(sound.all(dim=0), value, math.inf)
