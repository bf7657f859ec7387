"""Model predictive control by gradient descent on the action sequence."""

from __future__ import annotations

import functools
import math
import warnings
from typing import Any, Literal

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_vjepa.distributions.modes import MakeOptimizer
from torchrl_vjepa.planners.base import Planner
from torchrl_vjepa.planners.clock import Clock, check_max_ms
from torchrl_vjepa.planners.plan import Plan, check_counts
from torchrl_vjepa.planners.proposal import Proposal
from torchrl_vjepa.planners.squash import squash, unsquash

__all__ = ["GradientMPC"]


class GradientMPC(Planner):
    r"""Algorithm BJEPA gradient-based MPC of the paper: descend the imagined cost (``alg:bjepa_mpc``).

    .. math:: J(u) = \sum_{k=1}^{H} E_{\phi'}(\hat Z_k; \eta) + \lambda \|u_{k-1}\|^2, \qquad
        \hat Z_k = \mu_{\text{dyn}}(\hat Z_{k-1}, u_{k-1}), \qquad u \leftarrow u - \alpha \nabla_u J,

    where the environment's objective is :math:`J`: its cost, an energy, minus its reward, or a sum of them,
    the same objects that sampling planners evaluate. The rollout is that of the environment, the mean by
    default; with sampled trajectories and a ``risk`` the gradient goes through the samples, whose noise is
    the same in every step.

    **The best plan that was evaluated is returned**, the first one included: where the gradient
    misleads, the plan is still no worse than the warm start (or the centre of the bounds). Several starts
    descend at once: the first is the warm start or the centre, the others are drawn around it with the
    proposal's spread.

    **Rows are independent.** The objective is the sum over rows and starts, so no gradient reaches another
    row, and optimisers that work element by element (SGD, Adam, RMSprop, ...) never mix them. ``LBFGS``
    sees all rows and starts as one problem: its curvature and line search are common. A start whose cost
    is not finite has the cost infinity and no gradient; a gradient that is not finite counts as zero.

    **Bounds.** ``"project"`` puts the actions back onto the nearest bound after each step, and reaches
    optima on a bound in fewer steps; ``"reparameterize"`` searches free numbers that are squashed smoothly
    onto the bounds (:func:`~torchrl_vjepa.planners.squash.squash`). The variables that the optimiser sees
    are in units of the spread of a cold start, so the default step suits any range.

    **Modes.** Works inside ``torch.no_grad`` and ``torch.inference_mode``. Nothing is accumulated on the
    model's parameters, and the model's training mode is left as it is.

    **Constraints are refused**, with ``penalty`` too: a frequency of violations is a step function of the
    plan, its gradient is zero. Use a smooth barrier as a cost (with a ``risk``), or a
    :class:`~torchrl_vjepa.planners.sampling.SamplingPlanner`.

    Another planner's plan is refined by ``planner.plan(state, Proposal(found.best, found.std))``.

    Args:
        env: see :class:`Planner`. Gradients must flow through it from the actions to the cost.
        planning_horizon: see :class:`Planner`.
        optim_steps: gradient steps, at most; the last point is evaluated once more, without gradient.
        optimizer: makes an optimiser of the list of variables, which are in units of the spread of a cold
            start, for instance ``functools.partial(torch.optim.SGD, lr=0.1)``; by default Adam with a
            step of 0.2. It is made anew for each call.
        num_starts: starts ``S`` that descend side by side.
        bounds: how actions are kept inside.
        tolerance: a row is finished when its best cost has not fallen by more than this fraction in
            ``patience`` steps, and planning stops when all rows are; a finished row keeps its plan, so
            it does not depend on the others. Reads one number from the device in each step. ``None``:
            never.
        patience: see ``tolerance``.
        max_ms: time for a plan, in milliseconds: no step begins that would end later, with the evaluation of
            its end, if it took as long as the longest before it. The first always runs. Waits for the device
            after each step, and how far planning gets depends on the machine and the batch size.
        **kwargs: see :class:`Planner`; ``("plan_stats", "std")`` is the spread of the starts.

    Raises:
        ValueError: if an argument is out of its range, there are chance constraints, or the environment's
            prior has no gradient; else see :class:`Planner`. When planning: if no gradient flows from the
            actions to the cost, or to the prior in it.
        TypeError: if actions are discrete, or ``optimizer`` does not make an optimiser; else see
            :class:`Planner`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_vjepa.costs import quadratic_cost
        >>> from torchrl_vjepa.distributions import Delta
        >>> from torchrl_vjepa.envs import LatentEnv
        >>> def move(latent, action):
        ...     return Delta(latent + action)
        >>> env = LatentEnv(
        ...     move,
        ...     action_spec=Bounded(-1, 1, (1,)),
        ...     cost=quadratic_cost(torch.ones(1)),
        ...     latent_dim=1,
        ... )
        >>> planner = GradientMPC(env, planning_horizon=1, seed=0)
        >>> planner(TensorDict(latent=torch.tensor([0.5])))["action"].round(decimals=2)
        tensor([0.5000])
    """

    def __init__(
        self,
        env: EnvBase,
        planning_horizon: int,
        optim_steps: int = 50,
        *,
        optimizer: MakeOptimizer | None = None,
        num_starts: int = 4,
        bounds: Literal["reparameterize", "project"] = "project",
        tolerance: float | None = None,
        patience: int = 5,
        max_ms: float | None = None,
        **kwargs: Any,
    ) -> None:
        check_counts(num_starts=num_starts, patience=patience)
        if bounds not in ("reparameterize", "project"):
            raise ValueError(f"bounds must be 'reparameterize' or 'project', got {bounds!r}")
        if tolerance is not None and not 0 <= tolerance < 1:
            raise ValueError(f"tolerance must be in [0, 1), or None to never stop early, got {tolerance}")
        check_max_ms(max_ms)
        super().__init__(env, planning_horizon, optim_steps, **kwargs)
        if not self.codec.is_continuous:
            raise TypeError(
                "the actions of env must be continuous for gradient planning, got "
                f"{self.codec.describe()}; use a sampling planner (CEM, MPPI) for discrete ones"
            )
        if self._constrained:
            raise ValueError(
                "constraints must be empty for gradient planning: the frequency of violations has no "
                "gradient; use a smooth barrier as a cost, a sampling planner (CEM, MPPI), or lift those of "
                "env by constraints=[]"
            )
        prior = getattr(getattr(env, "world_model", None), "prior", None)
        if not getattr(prior, "differentiable", True):
            raise ValueError(
                f"env must not have a prior with differentiable=False, got {type(prior).__name__}; use a "
                "sampling planner (CEM, MPPI) for it"
            )
        self.optimizer = functools.partial(torch.optim.Adam, lr=0.2) if optimizer is None else optimizer
        # Made once here, so that what is no factory is refused before planning.
        made = self.optimizer([torch.zeros(1, requires_grad=True)]) if callable(self.optimizer) else None
        if not isinstance(made, torch.optim.Optimizer):
            got = f"{optimizer!r}" if made is None else f"one that makes {type(made).__name__}"
            raise TypeError(
                "optimizer must be a function that makes a torch optimiser of a list of tensors, for "
                f"instance functools.partial(torch.optim.SGD, lr=0.1), got {got}"
            )
        self.num_starts, self.bounds = num_starts, bounds
        self.tolerance, self.patience, self.max_ms = tolerance, patience, max_ms

    def plan(self, state: Any, proposal: Proposal) -> Plan:
        """Descend from the proposal's mean and from draws around it.

        Args:
            state: what ``planning_state`` of the environment gives, with batch ``*B``.
            proposal: where the search starts, with batch ``*B``.

        Returns:
            The best plan that was evaluated, both as ``actions`` and as ``best``; ``std`` is the proposal's.

        Raises:
            ValueError: if no gradient flows from the actions to the cost.
        """
        # Gradients are needed whatever the caller's mode; what inference mode made cannot be saved for
        # them, a copy can.
        with torch.inference_mode(False), torch.enable_grad():
            proposal = Proposal(*(part.detach().clone() for part in proposal))
            found = self._descend(state.detach().clone(), proposal)
        if not bool((found.guided | ~found.cost.isfinite()).all()):
            warnings.warn(
                "the cost has no finite gradient at any plan in at least one row: its action is that of the "
                "best start; check the energy and the cost for square roots and logarithms of zero",
                RuntimeWarning,
                stacklevel=3,
            )
        return Plan(found.actions, proposal.std, found.actions, found.cost)

    def _descend(self, state: Any, proposal: Proposal) -> _Incumbent:
        clock = Clock(self.max_ms, reserve=1)  # for the last point
        starts = self._starts(proposal)
        bounds = (self.low, self.high)
        squashed = self.bounds == "reparameterize"
        x = unsquash(starts, *bounds, self.cold_std) if squashed else starts / self.cold_std
        x.requires_grad_()
        found = _Incumbent(proposal.mean)
        noise = self._model_generator.get_state()
        cost_of = self._evaluator(state)

        def evaluate() -> Tensor:
            """Costs ``(*B, S)`` at the variables."""
            value = squash(x, *bounds, self.cold_std) if squashed else self.cold_std * x
            # The first plans are the starts exactly; and bounds hold exactly, yet let the gradient through.
            fixed = value.detach().clamp(*bounds) if found.evaluated else starts
            actions = fixed + (value - value.detach())
            # The model's noise is the same in every step: their costs compare.
            self._model_generator.set_state(noise)
            cost = cost_of(actions)
            finite = actions.detach().isfinite().flatten(-2).all(dim=-1)
            cost = torch.where(finite, cost, math.inf)
            found.offer(actions.detach(), cost.detach())
            return cost

        def closure() -> Tensor:
            cost = evaluate()
            objective = torch.where(cost.isfinite(), cost, 0.0).sum()
            gradient = None
            if objective.requires_grad:
                (gradient,) = torch.autograd.grad(objective, x, allow_unused=True)
            if gradient is None:
                raise ValueError(
                    "the cost must be differentiable in the actions, got one to which no gradient flows "
                    f"through {type(self.env).__name__}; use a sampling planner (CEM, MPPI) for it"
                )
            found.guided = found.guided | gradient.isfinite().flatten(-3).any(dim=-1)
            # LBFGS wants its gradients contiguous.
            x.grad = gradient.nan_to_num(0.0, 0.0, 0.0).contiguous()
            return objective.detach()

        optimizer = self.optimizer([x])
        for _ in range(self.optim_steps if x.numel() else 0):
            # LBFGS's types want floats where tensors do.
            optimizer.step(closure)  # type: ignore[arg-type]
            if not squashed:
                with torch.no_grad():
                    x.copy_((self.cold_std * x).clamp(*bounds) / self.cold_std)
            if self.tolerance is not None and not found.improves(self.tolerance, self.patience):
                return found
            if not clock.another(found.cost):
                break
        with torch.no_grad():
            evaluate()
        return found

    def _starts(self, proposal: Proposal) -> Tensor:
        """Plans ``(*B, S, H, A)`` inside the bounds: the mean, and draws around it."""
        mean, std = proposal
        noise = torch.randn(
            (self.num_starts - 1, *mean.shape[-2:]),
            generator=self._generator,
            device=mean.device,
            dtype=mean.dtype,
        )
        drawn = torch.addcmul(mean.unsqueeze(-3), std.unsqueeze(-3), noise)
        return torch.cat([mean.unsqueeze(-3), drawn], dim=-3).clamp(self.low, self.high)


class _Incumbent:
    """The best plan of each row so far, and whether the row still improves."""

    def __init__(self, actions: Tensor) -> None:
        self.evaluated = False
        self.guided = torch.zeros(actions.shape[:-2], dtype=torch.bool, device=actions.device)
        self.actions = actions
        self.cost = actions.new_full(actions.shape[:-2], math.inf)
        self.mark = self.cost  # at the last improvement that counted
        self.age = torch.zeros_like(self.cost)  # steps since then
        self.searching = torch.ones_like(self.cost, dtype=torch.bool)

    def offer(self, actions: Tensor, cost: Tensor) -> None:
        """Keep what is better, of plans ``(*B, S, H, A)`` that cost ``(*B, S)``."""
        lowest, index = cost.min(dim=-1)
        chosen = torch.take_along_dim(actions, index[..., None, None, None], -3).squeeze(-3)
        better = (lowest < self.cost) & self.searching
        self.actions = torch.where(better[..., None, None], chosen, self.actions)
        self.cost = torch.where(better, lowest, self.cost)
        self.evaluated = True

    def improves(self, tolerance: float, patience: int) -> bool:
        """Count one step; whether any row still improves."""
        bar = torch.where(self.mark.isfinite(), self.mark - tolerance * self.mark.abs(), math.inf)
        improved = self.cost < bar
        self.mark = torch.where(improved, self.cost, self.mark)
        self.age = torch.where(improved, 0.0, self.age + 1)
        self.searching = self.searching & (self.age < patience)
        return bool(self.searching.any())
