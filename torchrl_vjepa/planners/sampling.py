"""Planners that draw candidate plans, keep the best and refine the Gaussian they are drawn from."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable
from typing import Any, Literal

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_vjepa.planners.base import Planner
from torchrl_vjepa.planners.clock import Clock, check_max_ms
from torchrl_vjepa.planners.expansion import expansion_from
from torchrl_vjepa.planners.memory import Recalled
from torchrl_vjepa.planners.noise import coloured_noise_factor
from torchrl_vjepa.planners.plan import Plan, check_counts
from torchrl_vjepa.planners.proposal import Proposal
from torchrl_vjepa.planners.suggestions import policy_candidates, suggested_plans
from torchrl_vjepa.risk import REJECTED_COST

__all__ = ["SamplingPlanner"]


class SamplingPlanner(Planner):
    r"""Sampling-based model predictive control: propose plans, imagine them, refine the proposal.

    Each of ``optim_steps`` rounds draws ``num_candidates`` action sequences of length
    ``planning_horizon`` from the proposal (a Gaussian clamped to the action bounds; independent
    categorical distributions where actions are discrete), evaluates them in one call of
    the environment's objective, and hands the ``top_k`` best to :meth:`update`, the one method in
    which planners differ. The proposal's mean and the best plan so far are candidates of every
    round (if there are at least three), so the best plan never gets worse. The spread never
    exceeds that of a cold start.

    **Costs that are not finite rank last** (``nan`` and both infinities: a cost of minus infinity
    is a fault, not a good plan). Where no cost is finite the proposal keeps its mean, so the action
    is finite and inside the bounds, and one warning is given.

    **Risk.** The model's noise is common to all candidates and rounds. Plans that a chance constraint
    rejects have no part in the refinement as long as a feasible one is known; where there is none, the
    search heads for the least violation and a warning is given. The mean of feasible plans need not be
    feasible: ``output="best"`` returns a plan that was checked.

    **A policy** suggests the last ``num_policy_candidates`` plans of every round: what it does in the model,
    by point prediction (:func:`~torchrl_vjepa.planners.suggestions.suggested_plans`). So a learned policy is
    a start that planning improves, together with a ``terminal_value`` as in TD-MPC2, and one of no use costs
    its share of the candidates, no more.

    Args:
        env: see :class:`Planner`.
        planning_horizon: see :class:`Planner`.
        optim_steps: rounds.
        num_candidates: plans ``N`` per round.
        top_k: elites ``K`` that refine the proposal; ``num_candidates // 8`` by default.
        min_std: floor under the spread, as a fraction of the one after a cold start; for discrete actions,
            the weight of the uniform distribution in the proposal.
        antithetic: draw noise in pairs of opposite sign.
        chunk_size: candidates (of every row) that are imagined at a time; all by default. The memory of a
            plan is at most that of one with ``num_candidates=chunk_size``, and ten times the candidates
            ``(*B, N, H, A)``, beside what a ``policy`` computes for its plans; the plan is the same up to
            rounding, except in environments that draw their own noise.
        max_ms: time for a plan, in milliseconds: no round begins that would end later, if it took as long as
            the longest before it. A policy's plans and the first round always run; the plan is that of the
            rounds that did. Waits for the device after each round, and how far planning gets depends on the
            machine and the batch size.
        output: the plan is the ``"mean"`` of the proposal (where actions are discrete its most probable
            plan), or the ``"best"`` candidate seen.
        noise_beta: colour of the noise along a plan, from 0 (white: every step is drawn alone) to 4: with a
            power spectrum of :math:`1/f^\beta` candidates hold a direction, or a choice, for some time
            (:func:`~torchrl_vjepa.planners.noise.coloured_noise_factor`).
        keep_elites: fraction of the elites that are candidates again in the next round, beside the best,
            which always is.
        carry_elites: fraction of the last round's elites that are candidates in the first round of the next
            step, one step on; needs ``warm_start``. They are carried in the tensordict, under ``plan_key``
            with ``_elites`` appended.
        population_decay: candidates of a round as a fraction of those of the round before, but at least
            twice ``top_k``: later rounds search a smaller space. With 0.8, ``keep_elites`` and
            ``carry_elites`` of 0.3 and ``noise_beta=2``, CEM is iCEM.
        policy: a TorchRL actor (or a ``TensorDictSequential`` with one at its end) that reads the latent (of
            an environment that is stepped: entries of its state) and writes the environment's action. Actions
            outside the bounds are put inside, those that are not finite replaced by the proposal's mean. Its
            draws are common to all rows: its distribution must be one that
            :func:`~torchrl_vjepa.common_random_numbers.sample_common` has a rule for. ``None``: no
            suggestions.
        num_policy_candidates: how many of the ``num_candidates`` are the policy's: the first by its
            deterministic action (``ExplorationType.DETERMINISTIC``), the others drawn from its distribution.
            By default a twentieth of ``num_candidates``, or 1 for a policy that is deterministic.
        **kwargs: see :class:`Planner`.

    Raises:
        ValueError: if an argument is out of its range, or a policy writes a wrong shape; else see
            :class:`Planner`.
        TypeError: if a policy has no distribution that can be drawn so; else see :class:`Planner`.
        KeyError: if a policy reads or writes other entries.

    Examples:
        A planner of one's own is one method:

        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_vjepa.costs import quadratic_cost
        >>> from torchrl_vjepa.distributions import Delta
        >>> from torchrl_vjepa.envs import LatentEnv
        >>> class LocalSearch(SamplingPlanner):
        ...     def update(self, proposal, elites, costs):
        ...         return Proposal(elites[..., 0, :, :], 0.5 * proposal.std)
        >>> def move(latent, action):
        ...     return Delta(latent + action)
        >>> env = LatentEnv(
        ...     move,
        ...     action_spec=Bounded(-1, 1, (1,)),
        ...     cost=quadratic_cost(torch.ones(1)),
        ...     latent_dim=1,
        ... )
        >>> planner = LocalSearch(env, planning_horizon=1, optim_steps=8, seed=0)
        >>> out = planner(TensorDict(latent=torch.tensor([0.5])))
        >>> out["action"].round(decimals=2), out["next", "plan"].shape
        (tensor([0.5000]), torch.Size([1, 1]))
    """

    _colour: Tensor | None

    def __init__(
        self,
        env: EnvBase,
        planning_horizon: int,
        optim_steps: int = 4,
        num_candidates: int = 512,
        top_k: int | None = None,
        *,
        min_std: float = 0.01,
        antithetic: bool = True,
        chunk_size: int | None = None,
        max_ms: float | None = None,
        output: Literal["mean", "best"] = "mean",
        noise_beta: float = 0.0,
        keep_elites: float = 0.0,
        carry_elites: float = 0.0,
        population_decay: float = 1.0,
        policy: TensorDictModuleBase | None = None,
        num_policy_candidates: int | None = None,
        **kwargs: Any,
    ) -> None:
        check_counts(num_candidates=num_candidates)
        if top_k is None:
            top_k = max(1, num_candidates // 8)
        if not 1 <= top_k <= num_candidates:
            raise ValueError(f"top_k must be in [1, num_candidates={num_candidates}], got {top_k}")
        if not 0 < min_std <= 1:
            raise ValueError(f"min_std must be in (0, 1], got {min_std}")
        if output not in ("mean", "best"):
            raise ValueError(f"output must be 'mean' or 'best', got {output!r}")
        if chunk_size is not None:
            check_counts(chunk_size=chunk_size)
        check_max_ms(max_ms)
        if not 0 <= noise_beta <= 4:
            raise ValueError(f"noise_beta must be in [0, 4], got {noise_beta}")
        for name, fraction in (("keep_elites", keep_elites), ("carry_elites", carry_elites)):
            if not 0 <= fraction <= 1:
                raise ValueError(f"{name} must be in [0, 1], got {fraction}")
        if not 0 < population_decay <= 1:
            raise ValueError(f"population_decay must be in (0, 1], got {population_decay}")
        if population_decay < 1 and 2 * top_k >= num_candidates:
            raise ValueError(
                "population_decay must be 1 where twice top_k is no less than num_candidates="
                f"{num_candidates}, got {population_decay} with top_k={top_k}"
            )
        if num_policy_candidates is not None:
            check_counts(num_policy_candidates=num_policy_candidates)
            if policy is None:
                raise ValueError(
                    f"num_policy_candidates must be None without a policy, got {num_policy_candidates}"
                )
        super().__init__(env, planning_horizon, optim_steps, **kwargs)
        if carry_elites and not self.warm_start:
            raise ValueError(f"carry_elites must be 0 without warm_start, got {carry_elites}")
        self.policy: Any = policy
        self.num_policy_candidates = 0
        if policy is not None:
            source = self._source
            self.num_policy_candidates = policy_candidates(
                source, env, self.codec, policy, num_policy_candidates, num_candidates
            )
        # The mean and the best plan are candidates always.
        self._num_free = max(0, num_candidates - self.num_policy_candidates - 2)
        carried = math.ceil(carry_elites * top_k)
        if carried > self._num_free:
            raise ValueError(
                f"carry_elites must be of at most {self._num_free} plans, what num_candidates="
                f"{num_candidates} have room for, got {carry_elites} of top_k={top_k}"
            )
        self._remember(carried)
        self.chunk_size, self.max_ms = chunk_size, max_ms
        self.num_candidates, self.top_k = num_candidates, top_k
        self.min_std, self.antithetic, self.output = min_std, antithetic, output
        self.noise_beta, self.keep_elites, self.carry_elites = noise_beta, keep_elites, carry_elites
        self.population_decay = population_decay
        # The best plan is a candidate again anyway, so it is the next ones that are kept.
        self._num_kept = min(math.ceil(keep_elites * top_k), top_k - 1, self._num_free)
        colour = coloured_noise_factor(self.num_decisions, noise_beta) if noise_beta else None
        self.register_buffer("_colour", None if colour is None else colour.to(self.low), persistent=False)

    @abc.abstractmethod
    def update(self, proposal: Proposal, elites: Tensor, costs: Tensor) -> Proposal:
        """Refine the proposal: the one method in which planners differ.

        Args:
            proposal: what the candidates were drawn from.
            elites: the best candidates of this round, best first, of shape ``(*B, K, H, A)``.
            costs: their costs, of shape ``(*B, K)``; infinite for those that were not finite, never
                ``nan``. What is returned for rows without any finite cost is not used.

        Returns:
            The next proposal; the base class puts its mean inside the bounds and its spread
            between the floor and the spread of a cold start.
        """

    def plan(self, state: Any, proposal: Proposal, suggested: Tensor | None = None) -> Plan:
        """Plan from a state: the whole algorithm, on tensors.

        Args:
            state: what ``planning_state`` of the environment gives, with batch ``*B``.
            proposal: where the search starts, with batch ``*B``.
            suggested: plans that are candidates of the first round, of shape ``(*B, E, H, A)``, ``E`` at most
                ``num_candidates - num_policy_candidates - 2`` (those behind are left out); put inside the
                bounds, drawn where they are not finite.

        Returns:
            The plan. No value leaves the device.
        """
        codec, confine = self.codec, self.family.confinement(self.min_std)
        if suggested is not None and suggested.shape[-2:] != proposal.mean.shape[-2:]:
            raise ValueError(
                f"suggested must be plans of shape {tuple(proposal.mean.shape[-2:])}, got "
                f"{tuple(suggested.shape[-2:])}"
            )
        best = codec.mode(proposal.mean)
        # Costs keep the dimensions of a plan, (*B, 1, 1): they choose between plans.
        best_cost = infinite = best.new_full((*best.shape[:-2], 1, 1), math.inf)
        generator, top_k, constrained = self._model_generator, self.top_k, self._constrained
        model_state = generator.get_state()
        evaluate = self._evaluator(state)
        clock = Clock(self.max_ms)
        acted = self._policy_plans(state, proposal)
        if acted is not None:
            clock.begin()
        kept = None if suggested is None else suggested[..., : self._num_free, :, :]
        for round_ in range(self.optim_steps):
            # The model's noise is the same in every round: costs of different rounds compare.
            generator.set_state(model_state)
            num = self._population(round_) - self.num_policy_candidates
            candidates = self._candidates(proposal, best, kept, num)
            if acted is not None:
                candidates = torch.cat([candidates, acted], dim=-3)
            costs = evaluate(candidates)
            elite_costs, index = costs.topk(top_k, dim=-1, largest=False)
            if constrained:
                feasible = elite_costs < REJECTED_COST
                elite_costs = torch.where(feasible[..., :1] & ~feasible, math.inf, elite_costs)
            index = index[..., None, None].expand(*index.shape, *candidates.shape[-2:])
            elites = candidates.gather(-3, index)
            kept = elites[..., 1 : 1 + self._num_kept, :, :] if self._num_kept else None
            lowest = elite_costs.narrow(-1, 0, 1).unsqueeze(-1)  # infinite where no cost is finite
            best = torch.where(lowest < best_cost, elites.select(-3, 0), best)
            best_cost = torch.minimum(lowest, best_cost)
            mean, std = self.update(proposal, elites, elite_costs)
            found = lowest < infinite
            mean = torch.where(found, mean, proposal.mean)
            std = torch.where(found, std, proposal.std)
            proposal = confine(Proposal(mean, std))
            if not clock.another(best_cost):
                break
        best_cost = best_cost[..., 0, 0]
        actions = codec.mode(proposal.mean) if self.output == "mean" else best
        if self._constrained and self.output == "mean":
            # The mean of feasible plans may be none (around an obstacle it lies in it).
            self._model_generator.set_state(model_state)
            cost = evaluate(actions.unsqueeze(-3))[..., 0]
            worse = (cost >= REJECTED_COST) & (best_cost < cost)
            actions = torch.where(worse[..., None, None], best, actions)
        carried = elites[..., : self.memory.num_elites, :, :] if self.memory.num_elites else None
        return Plan(actions, proposal.std, best, best_cost, elites=carried)

    def _population(self, round_: int) -> int:
        decayed = round(self.num_candidates * self.population_decay**round_)
        least = max(2 * self.top_k, self.num_policy_candidates + 2 + self._num_kept)
        return min(self.num_candidates, max(decayed, least))

    def _search(self, state: Any, start: Proposal, recalled: Recalled) -> Plan:
        if recalled.elites is None:
            return super()._search(state, start, recalled)
        suggested = recalled.elites[..., :: self.action_repeat, :]
        return self.plan(state, start, suggested).held(self.action_repeat)

    def _evaluator(self, state: Any) -> Callable[[Tensor], Tensor]:
        evaluate = super()._evaluator(state)
        size, generator = self.chunk_size, self._model_generator
        if size is None:
            return evaluate

        def in_chunks(candidates: Tensor) -> Tensor:
            noise = generator.get_state()
            costs = []
            for chunk in candidates.split(size, dim=-3):
                generator.set_state(noise)  # common to all candidates
                costs.append(evaluate(chunk))
            return torch.cat(costs, dim=-1)

        return in_chunks

    def _policy_plans(self, state: Any, proposal: Proposal) -> Tensor | None:
        """Plans ``(*B, n, H, A)`` of the policy, if there is one."""
        if self.policy is None:
            return None
        mean, num = proposal.mean, self.num_policy_candidates
        if not mean.numel():
            return mean.unsqueeze(-3).expand(*mean.shape[:-2], num, *mean.shape[-2:])
        expansion = expansion_from(self._source, state, self.planning_horizon, self.action_repeat)
        return suggested_plans(expansion, self.policy, self.codec, mean, num, self._generator)

    def _candidates(
        self, proposal: Proposal, best: Tensor, kept: Tensor | None = None, num: int | None = None
    ) -> Tensor:
        """Candidates ``(*B, N, H, A)`` inside the bounds, the mean and the best plan among them."""
        mean = proposal.mean
        num = self.num_candidates if num is None else num
        drawn = (num + 1) // 2 if self.antithetic else num
        noise = torch.randn(
            (drawn, mean.shape[-2], self.family.noise_dim),
            generator=self._generator,
            device=mean.device,
            dtype=mean.dtype,
        )
        if self._colour is not None:
            noise = self._colour @ noise
        if self.antithetic:
            noise = torch.cat([noise, -noise])[:num]
        candidates = self.family.draw(proposal, noise)
        if num > 1:
            candidates[..., 0, :, :] = self.codec.mode(mean)
        if num > 2:
            candidates[..., 1, :, :] = best
        if kept is not None and kept.shape[-3]:
            last = candidates[..., num - kept.shape[-3] :, :, :]
            exists = kept.isfinite().flatten(-2).all(dim=-1)[..., None, None]
            kept = self.codec.mode(kept.clamp(self.low, self.high))
            last.copy_(torch.where(exists, kept, last))
        return candidates
