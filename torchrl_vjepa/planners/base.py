"""What every planner shares: TorchRL's edges, the proposal, warm start and risk."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.envs.transforms import TensorDictPrimer
from torchrl.modules import MPCPlannerBase

from torchrl_vjepa.actions import ActionCodec
from torchrl_vjepa.generators import offspring, pack_generator, unpack_generator
from torchrl_vjepa.planners.env_objective import EnvObjective
from torchrl_vjepa.planners.memory import PlanMemory, Recalled
from torchrl_vjepa.planners.plan import Plan, check_counts, warn_of_costs
from torchrl_vjepa.planners.proposal import Proposal, ProposalFamily
from torchrl_vjepa.planners.source import admit_head, checked_sampling, probe_value
from torchrl_vjepa.risk import ChanceConstraint, Risk
from torchrl_vjepa.state_heads import Head

__all__ = ["Planner"]

_STATISTICS = ("actions", "std", "cost", "violation")
_SAMPLING = ("num_samples", "risk", "constraints", "fusion", "terminal_value")
_GENERATORS = ("_generator", "_model_generator")


class _Found(NamedTuple):
    """What is planned from, the plan, and how many of its steps were executed before."""

    state: Any
    plan: Plan
    age: Tensor | None


class Planner(MPCPlannerBase):
    r"""Model predictive control in an imagined environment: what all planners share.

    A planner searches action sequences of length ``planning_horizon`` for the one of least cost under
    the environment's objective, and executes its first step. How it searches is :meth:`plan`, the one
    method that a subclass gives: :class:`~torchrl_vjepa.planners.sampling.SamplingPlanner` draws
    candidates, :class:`~torchrl_vjepa.planners.gradient.GradientMPC` follows the gradient. The actions
    they return are finite and inside the bounds. Where no cost is finite, one warning is given.

    **Risk.** ``num_samples`` trajectories per plan, their ``risk`` and chance ``constraints`` replace
    those of the environment, for this planner.

    **Memory between steps is in the tensordict.** With ``warm_start`` the planner reads
    ``plan_key`` and ``init_key`` and writes ``("next", plan_key)``, the plan shifted by one step
    with its last action repeated. Rows with ``init_key`` set or a plan that is not finite, and inputs
    without a plan, start cold, from the centre of the bounds; without ``init_key`` so do rows with a plan
    that is all zeros, which is what the primer gives.
    ``get_env_transforms_from_module(policy)`` gives the environment what it needs.

    **Any action.** Plans are searched in the flat code of :class:`~torchrl_vjepa.actions.ActionCodec`, ``A``
    floats: itself where the action is one continuous tensor, one-hot blocks and bits where it is discrete,
    one after the other where there are several. What is executed is decoded: all tensors of the action, in
    the shapes and dtypes of the specification. The entries that hold whole plans (``plan_key``,
    ``("plan_stats", "actions")``, ``std``) have the action's shape for one continuous tensor, and stay in
    code otherwise. Masks of the specification (``OneHot``, ``Categorical``) hold for all steps of a plan.

    **Randomness** comes from a generator of the planner's own; the global random state is never
    touched. All rows of a batch see the same noise: planning for many environments at once equals
    planning for each alone from the same generator state, in any order. The generator's state
    travels with pickling and ``copy.deepcopy``: workers of a collector draw the same noise unless
    :meth:`set_seed` is called in them. Models, values and policies are called in the mode they are in: what
    they draw in training mode (dropout) is their own.

    Args:
        env: a :class:`~torchrl_vjepa.envs.LatentEnv`, or any TorchRL environment that is not
            batch-locked, which is then stepped (see :class:`EnvObjective`).
        planning_horizon: steps ``H`` that are imagined.
        optim_steps: rounds of the search.
        action_key: where the action is written, if it is one tensor; the environment's by default.
        warm_start: start from the plan of the step before.
        warm_std: the spread after a warm start, as a fraction of the one after a cold start; for discrete
            actions, the probability with which a choice is drawn anew.
        init_std: spread of the proposal after a cold start: a fraction of half the range where the
            action is bounded (0.5 by default), in units of the action where it is not (no default).
        replan_interval: steps of a plan that are executed before the next search, a multiple of
            ``action_repeat`` and that by default. How many were is counted in the tensordict, under
            ``plan_key`` with ``_age`` appended, for each row: only rows whose turn it is are searched. The
            plan is remembered for that even without ``warm_start``.
        action_repeat: steps for which every action of a plan is held, imagined and executed;
            ``planning_horizon`` is a multiple of it. So ``H / action_repeat`` decisions are searched.
        num_samples: trajectories ``M`` imagined for each plan; the environment's way by default.
        risk: ``(costs (M, *B)) -> (*B)`` of their costs, for instance
            :func:`~torchrl_vjepa.risk.cvar`; the environment's by default.
        constraints: chance constraints on them (:class:`~torchrl_vjepa.risk.ChanceConstraint`); the
            environment's by default.
        fusion: how the environment's prior enters the cost of a plan: as an ``"energy"``, or by posterior
            (``"weight"``, ``"propose"``; see :class:`~torchrl_vjepa.envs.LatentEnv`); the environment's by
            default.
        terminal_value: what a plan is worth behind its horizon, :math:`J = \sum_k c_k - a_H V(Z_{t+H})` with
            the probability :math:`a_H` that the episode has not ended: latents ``(*B, D)`` to values
            ``(*B)``, expected sums of rewards (minus costs), higher is better; or a TensorDictModule that
            reads the latent (of an environment that is stepped: entries of its state) and writes
            ``state_value``, ``(*B, 1)``, as :class:`~torchrl.modules.ValueOperator`. Each sampled trajectory
            has its own. It is part of ``("plan_stats", "cost")``.
        compile: call the objective through ``torch.compile``, with these options (``{"mode":
            "reduce-overhead"}`` are CUDA graphs on a GPU). The first call, and the first of each new batch
            size, takes long.
        return_stats: also write ``("plan_stats", "actions")`` (the plan), ``("plan_stats", "std")``
            (spread of the proposal; of the one to start from in steps without a search),
            ``("plan_stats", "cost")`` (predicted cost of the plan) and, if there are ``C`` constraints,
            ``("plan_stats", "violation")`` (predicted probabilities, ``(*B, C)``); cost and violation from
            fresh noise. A mapping ``name -> risk`` also writes these
            risks of the plan's cost, from the same noise, under ``("plan_stats", name)``.
        plan_key: the plan's entry.
        init_key: set where an episode begins (``InitTracker``).
        seed: of the generator; by default the global seed, ``torch.initial_seed()``.
        generator: used instead of one made from ``seed``.

    Raises:
        ValueError: if an argument is out of its range, the bounds of an action are degenerate, or a risk
            or constraint has no samples to read.
        TypeError: if an action is of a kind that has no code, or the environment cannot evaluate the risk,
            constraints or terminal value.
        KeyError: if a terminal value reads or writes other entries.

    Examples:
        A search of one's own is one method:

        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_vjepa.costs import quadratic_cost
        >>> from torchrl_vjepa.distributions import Delta
        >>> from torchrl_vjepa.envs import LatentEnv
        >>> class Grid(Planner):
        ...     def plan(self, state, proposal):
        ...         actions = torch.linspace(-1, 1, 9).reshape(9, 1, 1)
        ...         cost, index = self.env.objective(state, actions).min(-1)
        ...         return Plan(actions[index], proposal.std, actions[index], cost)
        >>> def move(latent, action):
        ...     return Delta(latent + action)
        >>> env = LatentEnv(
        ...     move,
        ...     action_spec=Bounded(-1, 1, (1,)),
        ...     cost=quadratic_cost(torch.ones(1)),
        ...     latent_dim=1,
        ... )
        >>> planner = Grid(env, planning_horizon=1)
        >>> planner(TensorDict(latent=torch.tensor([0.5])))["action"]
        tensor([0.5000])
    """

    #: Names of :attr:`Plan.statistics`, which ``return_stats`` writes too.
    own_statistics: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self,
        env: EnvBase,
        planning_horizon: int,
        optim_steps: int = 4,
        *,
        action_key: NestedKey | None = None,
        warm_start: bool = True,
        warm_std: float = 0.3,
        init_std: float | None = None,
        replan_interval: int | None = None,
        action_repeat: int = 1,
        num_samples: int | None = None,
        risk: Risk | None = None,
        constraints: Sequence[ChanceConstraint] | None = None,
        fusion: Literal["energy", "weight", "propose"] | None = None,
        terminal_value: Head | None = None,
        compile: bool | Mapping[str, Any] = False,
        return_stats: bool | Mapping[str, Risk] = False,
        plan_key: NestedKey = "plan",
        init_key: NestedKey = "is_init",
        seed: int | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        check_counts(planning_horizon=planning_horizon, optim_steps=optim_steps)
        check_counts(action_repeat=action_repeat)
        if planning_horizon % action_repeat:
            raise ValueError(
                f"planning_horizon must be a multiple of action_repeat={action_repeat}, "
                f"got {planning_horizon}"
            )
        replan_interval = action_repeat if replan_interval is None else replan_interval
        check_counts(replan_interval=replan_interval)
        if replan_interval > planning_horizon or replan_interval % action_repeat:
            raise ValueError(
                f"replan_interval must be at most planning_horizon={planning_horizon} and a multiple of "
                f"action_repeat={action_repeat}, got {replan_interval}"
            )
        if not 0 < warm_std <= 1:
            raise ValueError(f"warm_std must be in (0, 1], got {warm_std}")
        if init_std is not None and not 0 < init_std < math.inf:
            raise ValueError(f"init_std must be positive and finite, got {init_std}")
        if seed is not None and generator is not None:
            raise ValueError("at most one of seed and generator must be given, got both")
        codec = ActionCodec(env.full_action_spec)
        family = ProposalFamily(codec, init_std)
        if action_key is not None and len(codec.keys) > 1:
            raise ValueError(
                f"action_key must be None for the several actions {codec.keys}, got {action_key!r}"
            )
        written = codec.keys if action_key is None else [unravel_key(action_key)]
        super().__init__(env, written[0])
        self.codec, self.family = codec, family
        # Looked up on the class: a transform around a LatentEnv must be stepped, not bypassed.
        offers_objective = callable(getattr(type(env), "objective", None))
        self._env_objective = None if offers_objective else EnvObjective(env, codec=codec)
        asked = {"num_samples": num_samples, "risk": risk, "constraints": constraints, "fusion": fusion}
        asked["terminal_value"] = terminal_value
        self._constrained = self._checked_sampling(_given(asked))
        if terminal_value is not None:
            admit_head(self._source, env, "terminal_value", terminal_value, ["state_value"])
            probe_value(self._source, "terminal_value", terminal_value)
        self.terminal_value: Any = terminal_value
        self.num_samples, self.risk, self.fusion = num_samples, risk, fusion
        self.constraints = None if constraints is None else nn.ModuleList(constraints)
        self.planning_horizon, self.optim_steps = planning_horizon, optim_steps
        self.compile_options = None if compile is False else {} if compile is True else dict(compile)
        self._compiled: Callable[..., Tensor] | None = None
        self.warm_start, self.warm_std = warm_start, warm_std
        self.return_stats, self.stats_risks = bool(return_stats), self._checked_risks(return_stats)
        self.replan_interval, self.action_repeat = replan_interval, action_repeat
        self._written, self._plan_key, self._init_key = written, plan_key, init_key
        self._remember(0)
        if generator is None:
            generator = torch.Generator(self.low.device)
            generator.manual_seed(torch.initial_seed() if seed is None else seed)
        self._generator = generator
        self._model_generator = offspring(generator, generator.device)

    def _remember(self, num_elites: int) -> None:
        """What is read and written, with so many plans carried beside the plan."""
        remembers = self.warm_start or self.replan_interval > 1
        self.memory = PlanMemory(
            self.codec,
            self.planning_horizon,
            self.replan_interval,
            num_elites,
            plan_key=self._plan_key if remembers else None,
            init_key=self._init_key,
        )
        own = self._env_objective
        self.in_keys = [*(self.env.planning_keys if own is None else own.in_keys), *self.memory.in_keys]
        self.out_keys = [*self._written, *self.memory.out_keys]
        if self.return_stats:
            constrained = None if self._constrained else -1
            names = [*_STATISTICS[:constrained], *self.stats_risks, *self.own_statistics]
            self.out_keys += [("plan_stats", name) for name in names]

    @property
    def num_decisions(self) -> int:
        """Actions of a plan that are searched: ``planning_horizon / action_repeat``."""
        return self.planning_horizon // self.action_repeat

    @property
    def low(self) -> Tensor:
        """Lower bounds of the code, ``(A)``."""
        return self.family.low

    @property
    def high(self) -> Tensor:
        """Upper bounds of the code, ``(A)``."""
        return self.family.high

    @property
    def centre(self) -> Tensor:
        """Mean of the proposal after a cold start, ``(A)``."""
        return self.family.centre

    @property
    def cold_std(self) -> Tensor:
        """Its spread, ``(A)``."""
        return self.family.cold_std

    @property
    def generator(self) -> torch.Generator:
        """The planner's own source of randomness."""
        return self._generator

    def set_seed(self, seed: int) -> None:
        """Seed the planner's generators.

        Args:
            seed: any integer that ``torch.Generator.manual_seed`` takes.
        """
        self._generator.manual_seed(seed)
        self._model_generator = offspring(self._generator, self._generator.device)

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The transform that carries the plan from step to step, zero at every reset.

        Returns:
            A primer of ``plan_key``; of nothing without ``warm_start``. It is found by TorchRL's
            ``get_env_transforms_from_module``, which also adds the ``InitTracker``.
        """
        return self.memory.primer(self.low)

    def planning(self, td: TensorDictBase) -> Tensor | TensorDictBase:
        """The action to execute.

        Args:
            td: where to plan from.

        Returns:
            Actions of shape ``(*B, *shape)``; a tensordict of them where there are several.
        """
        with torch.no_grad():
            code = self._plan_from(td).plan.actions[..., 0, :]
        return self.codec.executed(code)[0] if len(self.codec.keys) == 1 else self.codec.decode(code)

    def forward(
        self,
        tensordict: TensorDictBase,
        tensordict_out: TensorDictBase | None = None,
        **kwargs: Any,
    ) -> TensorDictBase:
        """Write the action, the plan for the next step and, if asked for, the statistics.

        Args:
            tensordict: where to plan from; only the entries that planning reads are touched.
            tensordict_out: where to write instead of the input.
            **kwargs: none is supported.

        Returns:
            The tensordict written to.

        Raises:
            TypeError: if another keyword is given.
            KeyError: if an entry is missing.
            ValueError: if a plan in the input has another shape.
        """
        if kwargs:
            raise TypeError(f"{type(self).__name__} takes no keywords, got {sorted(kwargs)}")
        with torch.no_grad():
            state, plan, age = self._plan_from(tensordict)
            written = self.codec.executed(plan.actions[..., 0, :])
            written += self.memory.entries(plan, age)
            if self.return_stats:
                # A copy: what is done to the executed action is not done to the statistics.
                written += [self.memory.shaped(plan.actions.clone()), self.memory.shaped(plan.std)]
                written += self._statistics(state, plan.actions.unsqueeze(-3))
                written += [plan.statistics[name] for name in self.own_statistics]
        out = tensordict if tensordict_out is None else tensordict_out
        for key, value in zip(self.out_keys, written, strict=True):
            out.set(key, value)
        return out

    @abc.abstractmethod
    def plan(self, state: Any, proposal: Proposal) -> Plan:
        """Plan from a state: the whole algorithm, on tensors.

        Args:
            state: what ``planning_state`` of the environment gives, with batch ``*B``.
            proposal: where the search starts, with batch ``*B`` and :attr:`num_decisions` steps.

        Returns:
            The plan of so many steps, inside the bounds and without gradient.
        """

    @property
    def _source(self) -> Any:
        return self.env if self._env_objective is None else self._env_objective

    def _plan_from(self, tensordict: TensorDictBase) -> _Found:
        state = self._source.planning_state(tensordict)
        batch = state.shape[:-1] if isinstance(state, Tensor) else state.batch_size
        self._follow_device()
        recalled = self.memory.recall(tensordict, batch, self.low)
        start = self._start(recalled, batch)
        if self.replan_interval == 1 or recalled.age is None:
            plan = self._search(state, start, recalled)
        else:
            # Each step draws as much, whoever searches: the noise of a row is not a matter of the others.
            own = self._generator, self._model_generator
            self._generator, self._model_generator = (offspring(each, each.device) for each in own)
            try:
                plan = self._continued(state, start, recalled)
            finally:
                self._generator, self._model_generator = own
        warn_of_costs(plan.best_cost, self._constrained)
        return _Found(state, plan, recalled.age)

    def _continued(self, state: Any, start: Proposal, recalled: Recalled) -> Plan:
        """Rows in the middle of a plan go on with it; the others are searched."""
        if recalled.plan is None or recalled.age is None or not bool((recalled.age > 0).any()):
            return self._search(state, start, recalled)
        stored = self.codec.mode(recalled.plan.clamp(self.low, self.high))
        std = start.std.repeat_interleave(self.action_repeat, dim=-2)
        cost = torch.zeros_like(stored[..., 0, 0])
        plan = Plan(stored, std, stored, cost, self._no_statistics(start), recalled.elites)
        due = recalled.age == 0
        if not bool(due.any()):
            return plan
        elites = None if recalled.elites is None else recalled.elites[due]
        parts = Recalled(recalled.plan[due], recalled.warm[due], recalled.age[due], elites)
        return plan.replaced(due, self._search(state[due], Proposal(start.mean[due], start.std[due]), parts))

    def _no_statistics(self, start: Proposal) -> dict[str, Tensor]:
        """Values of :attr:`own_statistics` in a step without a search."""
        return {}

    def _search(self, state: Any, start: Proposal, recalled: Recalled) -> Plan:
        """A plan of all steps, from what is remembered."""
        return self.plan(state, start).held(self.action_repeat)

    def _start(self, recalled: Recalled, batch: torch.Size) -> Proposal:
        """Proposal from the plan of the step before where there is one, else from the bounds."""
        cold = self.family.cold(batch, self.num_decisions)
        if recalled.plan is None or not self.warm_start:
            return cold
        start = self.family.around(recalled.plan[..., :: self.action_repeat, :], self.warm_std)
        warm = recalled.warm[..., None, None]
        return Proposal(*(torch.where(warm, a, b) for a, b in zip(start, cold, strict=True)))

    def _checked_sampling(self, asked: dict[str, Any]) -> bool:
        """Refuse early what the environment cannot evaluate; true if there are constraints."""
        settings = checked_sampling(self._source, self.env, asked)
        return settings is not None and bool(settings.constraints)

    def _statistics(self, state: Any, plan: Tensor) -> list[Tensor]:
        """Cost and, if there are constraints, probabilities of violation, from the same noise."""
        noise = self._model_generator.get_state()
        statistics = [self._costs(state)(plan)]
        if self._constrained:
            self._model_generator.set_state(noise)
            asked = _given({"num_samples": self.num_samples, "constraints": self.constraints})
            generator = self._model_generator
            frequency = self._source.violation_probability(state, plan, generator=generator, **asked)
            statistics.append(frequency.squeeze(-2))
        for risk in self.stats_risks.values():
            self._model_generator.set_state(noise)
            alone = {"constraints": ()} if self._constrained else {}
            statistics.append(self._costs(state, risk=risk, **alone)(plan))
        return statistics

    def _checked_risks(self, return_stats: bool | Mapping[str, Risk]) -> dict[str, Risk]:
        """The risks that are reported, refused early where they cannot be."""
        if not isinstance(return_stats, (bool, Mapping)):
            raise TypeError(
                "return_stats must be True, False or risks by name, for instance {'worst tenth': cvar(0.1)}, "
                f"got {type(return_stats).__name__}"
            )
        risks = dict(return_stats) if isinstance(return_stats, Mapping) else {}
        for name, risk in risks.items():
            if name in _STATISTICS:
                raise ValueError(f"return_stats must not rename {name!r}, which is always written")
            self._checked_sampling(_given({name: getattr(self, name) for name in _SAMPLING}) | {"risk": risk})
        return risks

    def _evaluator(self, state: Any) -> Callable[[Tensor], Tensor]:
        """``candidates (*B, N, H / action_repeat, A) -> costs (*B, N)`` of one planning call."""
        costs, repeat = self._costs(state), self.action_repeat
        if repeat == 1:
            return costs
        return lambda candidates: costs(candidates.repeat_interleave(repeat, dim=-2))

    def _costs(self, state: Any, **instead: Any) -> Callable[[Tensor], Tensor]:
        """``plans (*B, N, H, A) -> costs (*B, N)`` of one planning call, infinite where not finite."""
        asked = _given({name: getattr(self, name) for name in _SAMPLING}) | instead
        source, generator = self._source, self._model_generator
        # A subclass that gives another objective alone must be asked for that.
        owner = next(cls for cls in type(source).__mro__ if "objective" in vars(cls))
        if self.compile_options is None and "objective_from" in vars(owner):
            objective = source.objective_from(state, **asked)
        else:

            def objective(candidates: Tensor, generator: torch.Generator) -> Tensor:
                return self._called(source.objective, state, candidates, generator=generator, **asked)

        def evaluate(candidates: Tensor) -> Tensor:
            costs = objective(candidates, generator)
            # Never rounded to the dtype of the actions: differences of large costs would be lost.
            dtype = torch.promote_types(costs.dtype, candidates.dtype)
            return costs.to(dtype).nan_to_num(math.inf, math.inf, math.inf)

        return evaluate

    def _called(self, objective: Callable[..., Tensor], *args: Any, **kwargs: Any) -> Tensor:
        """The objective's answer, compiled if that was asked for."""
        if self.compile_options is None:
            return objective(*args, **kwargs)
        if self._compiled is None:
            self._compiled = torch.compile(objective, **self.compile_options)
        try:
            return self._compiled(*args, **kwargs)
        except torch._dynamo.exc.TorchDynamoException as error:
            raise RuntimeError(
                f"compile must be False for the objective of {type(self.env).__name__} on this machine: "
                f"torch.compile failed with {type(error).__name__}: {error}"
            ) from error

    def __getstate__(self) -> dict[str, Any]:
        packed = {name: pack_generator(self.__dict__[name]) for name in _GENERATORS}
        return {**super().__getstate__(), **packed, "_compiled": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        unpacked = {name: unpack_generator(state[name]) for name in _GENERATORS}
        super().__setstate__({**state, **unpacked})

    def _follow_device(self) -> None:
        """Generators live on one device: after ``.to(device)`` new ones continue from the old."""
        if self._generator.device != self.low.device:
            self._generator = offspring(self._generator, self.low.device)
            self._model_generator = offspring(self._generator, self.low.device)


def _given(arguments: dict[str, Any]) -> dict[str, Any]:
    """Those that are not None: the environment's own settings hold for the rest."""
    return {name: value for name, value in arguments.items() if value is not None}
