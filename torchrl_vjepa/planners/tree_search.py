"""Monte Carlo tree search with PUCT over finitely many actions, in many rows at once."""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.modules.mcts import MCTSScore, PUCTScore

from torchrl_vjepa.planners.clock import Clock, check_max_ms
from torchrl_vjepa.planners.discrete import DiscretePlanner
from torchrl_vjepa.planners.expansion import ALIVE, Expansion, State, entries
from torchrl_vjepa.planners.plan import Plan, check_counts
from torchrl_vjepa.planners.proposal import Proposal
from torchrl_vjepa.planners.search_tree import SearchTree
from torchrl_vjepa.planners.source import admit_head, latent_key_of
from torchrl_vjepa.state_heads import Head, call_head, state_value, while_alive

__all__ = ["TreeSearch"]


class TreeSearch(DiscretePlanner):
    r"""Monte Carlo tree search with PUCT over the point prediction of a model, for long horizons.

    Each of ``num_simulations`` simulations follows the best scores down the tree of action sequences to an
    action that has not been tried, imagines that one step, and puts the next state into the tree. What the
    simulation costs,

    .. math:: J = \sum_{k=0}^{d-1} \gamma^k c(\hat Z_{t+k+1}, u_{t+k}) + \gamma^d C(\hat Z_{t+d}),

    is averaged in all actions of its path. What comes behind depth ``d`` is

    - a **rollout** to the planning horizon by the prior policy (uniform by default), if ``leaf_value`` is
      ``None``: each simulation is then a whole plan, with the cost that the environment's objective gives it,
      the ``terminal_value`` of where it ends included;
    - or :math:`C = -V(\hat Z_{t+d})`, a learned value, at one model step per simulation.

    **Scores** are those of TorchRL's modules, :class:`~torchrl.modules.mcts.PUCTScore` by default,
    :math:`\tilde Q_a + c_{\text{puct}} P_a \sqrt{N} / (1 + N_a)`, on values that are normalised to
    :math:`[0, 1]` among the actions of a node, as in the reference implementation of MuZero: scale and offset
    of the costs do not matter (:class:`~torchrl_vjepa.planners.search_tree.SearchTree`).

    **All rows are searched at once**: their statistics are tensors, a simulation calls the model once for all
    rows. Rows are independent, and all see the same noise.

    **The plan** is the principal variation: the most visited actions, from the root on; of equal visits, the
    action of the best value; its last action repeated to the horizon. ``output="best"`` gives the cheapest
    simulation instead, for a model that is trusted: it never gets worse with more simulations, keeps a
    perfect warm start, and is the better plan where simulations are few. Visits average over what a branch
    may cost, and settle slowly between branches that are nearly equal.

    **Warm start**: the plan of the step before is the first simulation, and stays in the tree, state by
    state. The tree itself is not carried over: memory between steps is in the tensordict, and a tree's states
    belong to a latent that was predicted, not observed.

    Args:
        env: see :class:`DiscretePlanner`. Its next latent is a mean or a mode; or any TorchRL environment
            that is not batch-locked and deterministic.
        planning_horizon: depth ``H`` of the tree.
        num_simulations: simulations ``S``, each of which adds a node.
        exploration: :math:`c_{\text{puct}}`. Values span the whole of :math:`[0, 1]` in every node, so it is
            larger than where they are normalised over the tree.
        score: a module of :mod:`torchrl.modules.mcts` in place of ``PUCTScore(c=exploration)`` that reads
            ``win_count``, ``visits``, ``total_visits`` or ``prior_prob``, for instance ``UCBScore(c=1.4)``.
        discount: :math:`\gamma`, of costs and value; ``("plan_stats", "cost")`` is without.
        prior_policy: latents ``(R, D)`` to logits of the actions, ``(R, n)``; or a TensorDictModule that
            reads ``latent_key``: an actor that has ``get_dist``, or what writes ``logits``. Uniform by
            default.
        leaf_value: latents ``(R, D)`` to values ``(R)``, expected sums of rewards (minus costs), higher is
            better; or a TensorDictModule that reads ``latent_key`` and writes ``state_value``, ``(R, 1)``. It
            is weighted by the predicted probability of being alive. Rollouts that end in a value instead take
            ``terminal_value``.
        max_ms: time for a plan, in milliseconds: no simulation begins that would end later, if it took as
            long as the longest before it; the plan is that of those that ran. What is known of a warm start,
            and one simulation, always run.
        output: the plan is the principal variation of ``"visits"``, or the ``"best"`` simulation.
        return_stats: also writes ``("plan_stats", "visits")``, of the actions at the root, ``(*B, n)``, and
            ``("plan_stats", "value")``, minus the mean cost of the simulations, ``(*B, 1)``.
            ``("plan_stats", "std")`` is the spread of the visits along the plan. Zero in rows that execute a
            plan (``replan_interval``); the value is ``nan`` where no simulation has a finite cost.
        **kwargs: see :class:`Planner`.

    Raises:
        ValueError: if an argument is out of its range, or plans are judged by sampled trajectories. When
            planning: if a policy or value returns a wrong shape.
        TypeError: if ``score`` reads other statistics; else see :class:`DiscretePlanner`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import OneHot
        >>> from torchrl_vjepa.costs import quadratic_cost
        >>> from torchrl_vjepa.distributions import Delta
        >>> from torchrl_vjepa.envs import LatentEnv
        >>> def move(latent, action):  # left, stay, right
        ...     return Delta(latent + action[..., 2:] - action[..., :1])
        >>> env = LatentEnv(
        ...     move,
        ...     action_spec=OneHot(3),
        ...     cost=quadratic_cost(torch.tensor([3.0])),
        ...     latent_dim=1,
        ... )
        >>> planner = TreeSearch(env, planning_horizon=8, num_simulations=200, return_stats=True, seed=0)
        >>> out = planner(TensorDict(latent=torch.tensor([0.0])))
        >>> out["action"].int().argmax(), out["plan_stats", "visits"].sum()
        (tensor(2), tensor(200.))
    """

    own_statistics = ("visits", "value")

    def __init__(
        self,
        env: EnvBase,
        planning_horizon: int,
        num_simulations: int = 100,
        *,
        exploration: float = 4.0,
        score: MCTSScore | None = None,
        discount: float = 1.0,
        prior_policy: Head | None = None,
        leaf_value: Head | None = None,
        max_ms: float | None = None,
        output: Literal["visits", "best"] = "visits",
        **kwargs: Any,
    ) -> None:
        check_counts(num_simulations=num_simulations)
        if not 0 <= exploration < math.inf:
            raise ValueError(f"exploration must be finite and not negative, got {exploration}")
        if not 0 < discount <= 1:
            raise ValueError(f"discount must be in (0, 1], got {discount}")
        check_max_ms(max_ms)
        if output not in ("visits", "best"):
            raise ValueError(f"output must be 'visits' or 'best', got {output!r}")
        super().__init__(env, planning_horizon, num_simulations, **kwargs)
        if not self._is_deterministic():
            raise ValueError(
                "env must predict one next state for tree search (LatentEnv with how='mean' or 'mode', "
                "without belief_key, or an environment that is stepped), and no num_samples, risk or "
                "constraints can be given; use ExhaustiveSearch or a sampling planner (CEM) for those"
            )
        self.score: Any = PUCTScore(c=exploration) if score is None else score
        statistics = {"win_count", "visits", "total_visits", "prior_prob"}
        if not isinstance(self.score, MCTSScore) or not set(self.score.in_keys) <= statistics:
            raise TypeError(
                f"score must be a module of torchrl.modules.mcts that reads only {sorted(statistics)}, got "
                f"{type(score).__name__}"
            )
        if leaf_value is not None and self.terminal_value is not None:
            raise ValueError(
                "at most one of leaf_value and terminal_value must be given, got both: leaf_value is used at "
                "the horizon too"
            )
        logits = [] if hasattr(prior_policy, "get_dist") else ["logits"]
        heads = {"prior_policy": (prior_policy, logits), "leaf_value": (leaf_value, ["state_value"])}
        for name, (head, writes) in heads.items():
            if head is not None:
                self.in_keys = [*self.in_keys, *admit_head(self._source, env, name, head, writes)]
        self.max_ms = max_ms
        self.num_simulations, self.exploration, self.discount = num_simulations, exploration, discount
        self.prior_policy: Any = prior_policy
        self.leaf_value: Any = leaf_value
        self.output = output

    def plan(self, state: Any, proposal: Proposal) -> Plan:
        """Search from a state.

        Args:
            state: what ``planning_state`` of the environment gives, with batch ``*B``.
            proposal: where the search starts, with batch ``*B``: its nearest plan is the first simulation, in
                rows where it knows more than a cold start.

        Returns:
            The plan. ``best`` is the cheapest simulation, whose cost contains the leaf's value.
        """
        clock = Clock(self.max_ms)
        batch = proposal.mean.shape[:-2]
        shape = (self.num_simulations, self.num_decisions, self.num_actions)
        noise = proposal.mean.new_empty(shape).exponential_(generator=self._generator).log().neg()
        if not batch.numel():
            statistics = self._no_statistics(proposal)
            return Plan(*proposal, proposal.mean, proposal.mean[..., 0, 0], statistics)
        index, warm = self._numbered(proposal)
        any_warm = bool(warm.any())
        room = 1 + self.num_simulations + self.num_decisions * any_warm
        search = _Search(self, self._expansion(state), room)
        if any_warm:
            search.follow(index, warm)
            clock.begin()
        for gumbel in noise:
            search.simulate(gumbel)
            if not clock.another(search.best_cost):
                break
        tree = search.tree
        actions, shares = tree.principal_variation()
        if self.output == "best":
            found = search.best_cost.isfinite().unsqueeze(-1)
            actions = torch.where(found, search.best, actions)
        shares = shares.to(self.choices.dtype)
        mean = shares @ self.choices
        std = (shares @ self.choices.square() - mean.square()).clamp_min(0).sqrt()
        visits, finite = tree.visits[:, 0], tree.finite[:, 0]
        value = -(finite * tree.mean[:, 0]).sum(dim=-1) / finite.sum(dim=-1)
        plan, best = self._coded(actions), self._coded(search.best)
        statistics = {"visits": visits, "value": value.unsqueeze(-1)}

        def shaped(part: Tensor) -> Tensor:
            return part.reshape((*batch, *part.shape[1:]))

        return Plan(
            shaped(plan),
            shaped(std),
            shaped(best),
            shaped(search.best_cost),
            {name: shaped(part) for name, part in statistics.items()},
        )

    def _no_statistics(self, start: Proposal) -> dict[str, Tensor]:
        visits = start.mean.new_zeros(*start.mean.shape[:-2], self.num_actions)
        return {"visits": visits, "value": torch.zeros_like(visits[..., :1])}


class _Search:
    """One call: the trees, the states of their nodes, and the cheapest simulation so far."""

    def __init__(self, planner: TreeSearch, expansion: Expansion, num_nodes: int) -> None:
        self.planner, self.expansion, self.horizon = planner, expansion, planner.num_decisions
        root, self.latent_key = expansion.root, latent_key_of(planner._source)
        alive = root[ALIVE]
        self.rows = torch.arange(alive.shape[0], device=alive.device)
        self.dtype = torch.promote_types(planner.choices.dtype, alive.dtype)
        self.tree = SearchTree(self._prior(root), num_nodes, self.horizon, planner.score)
        self.states: State = {}
        for key, value in root.items():
            self.states[key] = value.new_empty(value.shape[0], num_nodes, *value.shape[1:])
        self.paid = self.tree.mean.new_zeros(alive.shape[0], num_nodes)  # from the root to each node
        self.cost = torch.zeros_like(self.paid)  # of the simulation that made the node
        self.best_cost = self.paid.new_full(alive.shape, math.inf)
        self.best = self.tree.depth.new_zeros(alive.shape[0], self.horizon)
        self.num_nodes = 0
        self._keep(root, self.paid[:, 0])

    def follow(self, plan: Tensor, warm: Tensor) -> None:
        """A plan ``(R, H)`` as a simulation whose states all go into the tree, in the warm rows ``(R)``."""
        state, paid = self.expansion.root, self.paid[:, 0]
        path = torch.arange(self.horizon, device=plan.device).expand_as(plan)
        for step, action in enumerate(plan.unbind(dim=1)):
            state, paid = self._step(state, paid, action, step)
            self.tree.add(self.num_nodes, path[:, step], action, self._prior(state), warm)
            self._keep(state, paid)
        cost = paid + self._leaf_cost(state, self.horizon)
        # Simulations that come back to the end of the plan cost what it did.
        self.cost[:, self.num_nodes - 1] = cost
        self.tree.backup(path, plan, cost, warm)
        self._offer(plan, torch.where(warm, cost, math.inf))

    def simulate(self, gumbel: Tensor) -> None:
        """One simulation, with noise ``(H, n)`` for its rollout."""
        tree, path = self.tree, self.tree.descend()
        actions = tree.choice.gather(1, path)
        parent, action = path[:, -1], actions[:, -1]
        depth = tree.depth[self.rows, parent]
        inside = depth < self.horizon
        before = {key: value[self.rows, parent] for key, value in self.states.items()}
        state, paid = self._step(before, self.paid[self.rows, parent], action, depth)
        tree.add(self.num_nodes, parent, action, self._prior(state), inside)
        # Behind its end a path repeats its last node: so does the plan its last action.
        short = max(0, self.horizon - actions.shape[1])
        plan = torch.cat([actions, action.unsqueeze(1).expand(-1, short)], dim=1)[:, : self.horizon]
        if self.planner.leaf_value is None:
            cost, plan = self._rolled_out(state, paid, depth + 1, plan, gumbel)
        else:
            cost = paid + self._leaf_cost(state, depth + 1)
        cost = torch.where(inside, cost, self.cost[self.rows, parent])
        self.cost[:, self.num_nodes] = cost
        self._keep(state, paid)
        tree.backup(path, actions, cost)
        self._offer(plan, torch.where(inside, cost, math.inf))

    def _step(self, state: State, paid: Tensor, action: Tensor, step: int | Tensor) -> tuple[State, Tensor]:
        """Next state and what has been paid then, from actions ``(R)``."""
        state, cost = self.expansion.expand(state, self.planner._coded(action), step)
        return state, paid + self._weight(step) * cost.to(paid.dtype)

    def _rolled_out(
        self, state: State, paid: Tensor, step: Tensor, plan: Tensor, gumbel: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Cost at the horizon, and the plan with the actions that were drawn on the way."""
        for _ in range(self.horizon - int(step.min())):
            inside = step < self.horizon
            index = step.clamp_max(self.horizon - 1)
            action = (self._prior(state).log() + gumbel[index]).argmax(dim=-1)
            following, after = self._step(state, paid, action, index)
            if self.planner.terminal_value is not None:  # it is that of the horizon, not of what comes after
                following = {key: _where(inside, value, state[key]) for key, value in following.items()}
            state, paid = following, torch.where(inside, after, paid)
            column = index.unsqueeze(1)
            drawn = torch.where(inside.unsqueeze(1), action.unsqueeze(1), plan.gather(1, column))
            plan = plan.scatter(1, column, drawn)
            step = step + 1
        return paid + self._leaf_cost(state, self.horizon), plan

    def _prior(self, state: State) -> Tensor:
        """Probabilities ``(R, n)`` of the actions; uniform where the policy gives none that are finite."""
        planner, rows = self.planner, state[ALIVE].shape[0]
        n, policy = planner.num_actions, planner.prior_policy
        uniform = torch.full((rows, n), 1 / n, dtype=self.dtype, device=self.rows.device)
        if policy is None:
            return uniform
        if hasattr(policy, "get_dist"):
            given = policy.get_dist(TensorDict(entries(state), batch_size=(rows,))).probs
        else:
            given = call_head(policy, entries(state), (rows,), self.latent_key, "logits").softmax(dim=-1)
        if tuple(given.shape) != (rows, n):
            raise ValueError(
                f"prior_policy must give one number for each of the {n} actions, of shape {(rows, n)}, got "
                f"{tuple(given.shape)}"
            )
        finite = given.isfinite().all(dim=-1, keepdim=True)
        return torch.where(finite, given.to(uniform.dtype), uniform)

    def _leaf_cost(self, state: State, depth: int | Tensor) -> Tensor | float:
        """Discounted cost ``(R)`` of what comes behind the leaves."""
        planner, alive = self.planner, state[ALIVE]
        name = "terminal_value" if planner.leaf_value is None else "leaf_value"
        head = getattr(planner, name)
        if head is None:
            return 0.0
        value = state_value(head, entries(state), alive.shape, self.latent_key, name=name)
        return -self._weight(depth) * while_alive(alive, value).to(self.paid.dtype)

    def _weight(self, step: int | Tensor) -> Tensor | float:
        discount = self.planner.discount**self.planner.action_repeat
        return discount**step if isinstance(step, int) else discount ** step.to(self.paid.dtype)

    def _keep(self, state: State, paid: Tensor) -> None:
        """Write a node's state and what was paid to reach it, at the next number."""
        for key, value in state.items():
            self.states[key][:, self.num_nodes] = value
        self.paid[:, self.num_nodes] = paid
        self.num_nodes += 1

    def _offer(self, plan: Tensor, cost: Tensor) -> None:
        """Keep the cheaper of two plans; ``nan`` is never cheaper, minus infinity is a fault."""
        better = (cost < self.best_cost) & cost.isfinite()
        self.best = torch.where(better.unsqueeze(1), plan, self.best)
        self.best_cost = torch.where(better, cost, self.best_cost)


def _where(rows: Tensor, one: Tensor, other: Tensor) -> Tensor:
    """Entries of one where the rows ``(R)`` say so, else of the other."""
    return torch.where(rows.reshape(-1, *[1] * (one.ndim - 1)), one, other)
