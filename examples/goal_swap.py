"""Swap tasks, keep the model: one VJEPA, trained without any reward, reaches what it is shown.

A VJEPA learns the dynamics of the noisy TV from random steps (noise scale 8: of what the camera sees, the
distractor has 64 times its plain variance) and is never touched again. Then tasks come as priors: reach a
goal that is given as one noisy frame; the same with one or two regions that must not be entered; follow a
circle that is given as a film. Every task is an entry of the tensordict, so all of them are planned as rows
of one batch, by one planner in one imagined world. The table says what each task costs, as a multiple of
what the optimal controller pays that knows the true system; beside it a reward head that is trained for each
goal, and a deterministic JEPA that minimises the distance to the encoded goal.
"""

from __future__ import annotations

import copy
import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean, median
from typing import Any, NamedTuple

import matplotlib as mpl
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs import StepCounter, TransformedEnv
from torchrl.modules import get_env_transforms_from_module
from tqdm import tqdm

from _goal_tasks import (
    EFFORT,
    NOWHERE,
    Task,
    make_tasks,
    references,
    run_oracle,
    stage_costs,
    violations,
)
from _noisy_tv import (
    Recipe,
    System,
    Trained,
    jepa_loss,
    make_jepa,
    make_vjepa,
    objective,
    train_restarts,
    train_reward,
    vjepa_loss,
)
from _settings import command_line, option, prepare, read_settings, write_report
from torchrl_vjepa import (
    MPPI,
    Ball,
    BatchedNoisyTVEnv,
    GoalPrior,
    GradientMPC,
    LatentEnv,
    LatentModel,
    LinearProbe,
    Planner,
    ProductPrior,
    QuadraticReward,
    RegionPrior,
    RewardLoss,
    action_cost,
    full_gaussian,
    linear_probe,
    recalibrate,
)

mpl.use("Agg")
from matplotlib import pyplot as plt

METHODS = {
    "lqg": "LQG (knows the system)",
    "lqg-seen-goal": "LQG, goal through the encoder",
    "lqg-seen-state": "LQG, state through the encoder",
    "bjepa": "BJEPA, MPPI",
    "bjepa-gradient": "BJEPA, gradient MPC",
    "bjepa-unlabelled": "BJEPA, no labels",
    "bjepa-unconstrained": "BJEPA, regions left out",
    "retrained": "reward head for each goal",
    "jepa": "JEPA + goal distance",
    "finetuned": "fine-tuned from task to task",
    "finetuned-kept-head": "fine-tuned, first head kept",
}
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#7F7F7F")
NOISE_SCALE = 8.0
FAMILIES = ("goal", "keep-out", "two-regions", "circle")
Row = dict[str, Any]


@dataclass
class Settings(Recipe):
    """What the run does; every field is a command-line option."""

    goals: int = option(8, "goals, spaced evenly around a circle of radius 1")
    goal_frames: int = option(1, "noisy frames that are averaged for each goal")
    period: int = option(40, "steps in which the circle is followed once")
    labels: int = option(100, "frames whose true signal is known: they set the units of energies")
    radius: float = option(0.3, "of the keep-out regions, in units of the signal")
    gap: float = option(0.08, "from where the optimal controller holds the signal to the edge of a region")
    margin: float = option(1.2, "regions are widened by so many predicted standard deviations")
    sharpness: float = option(40.0, "of their barrier, in nats per unit of the signal")
    planning_horizon: int = option(8, "steps that are imagined")
    optim_steps: int = option(5, "MPPI rounds for each action")
    num_candidates: int = option(256, "plans in an MPPI round")
    top_k: int = option(32, "elites of an MPPI round")
    temperature: float = option(1.0, "MPPI temperature, in standard deviations of the elites' costs")
    gradient_steps: int = option(20, "gradient steps for each action")
    gradient_lr: float = option(0.1, "their size, in units of the spread of a cold start")
    episodes: int = option(2, "evaluation episodes for each task")
    steps: int = option(200, "steps of an evaluation episode, at most 200")
    continual_tasks: int = option(10, "tasks in a row, after which the first is tried again")
    finetune_steps: int = option(200, "optimiser steps of the model that is fine-tuned on each task's reward")
    finetune_lr: float = option(0.003, "its peak learning rate")


QUICK = {
    "frames": 4_000,
    "restarts": 2,
    "train_steps": 300,
    "goals": 2,
    "episodes": 1,
    "steps": 60,
    "optim_steps": 2,
    "num_candidates": 64,
    "top_k": 8,
    "gradient_steps": 3,
    "continual_tasks": 2,
    "finetune_steps": 20,
}


class Tell(TensorDictModuleBase):
    """Writes the tasks of the rows into the tensordict: a film of the next steps, and where the regions are.

    Args:
        tasks: one for each row.
        horizon: how many steps ahead.
    """

    in_keys = ["step_count"]
    out_keys = ["goal", "obstacle", "second_obstacle"]

    def __init__(self, tasks: Sequence[Task], horizon: int) -> None:
        super().__init__()
        self.films = torch.stack([task.film for task in tasks])
        self.regions = torch.stack([task.regions for task in tasks]).float()
        self.ahead = torch.arange(1, horizon + 1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write them."""
        times = (tensordict["step_count"] + self.ahead).remainder(self.films.shape[1])
        rows = torch.arange(len(self.films)).unsqueeze(-1)
        tensordict["goal"] = self.films[rows, times]
        tensordict["obstacle"], tensordict["second_obstacle"] = self.regions.unbind(1)
        return tensordict


class Metric(NamedTuple):
    """How far latents are from each other in units of the signal, and where they are in the plane.

    Attributes:
        covariance: of the goal's Gaussian in the latent, whose energy is the squared distance, ``(4, 4)``.
        plane: weight ``(2, 4)`` and bias ``(2,)`` of the probe of the plane's coordinates.
        noise: standard deviation of a prediction there; 0 for a model that knows none.
    """

    covariance: Tensor
    plane: tuple[Tensor, Tensor]
    noise: float


def encode(encoder: TensorDictModuleBase, frames: Tensor) -> Tensor:
    """Latents of frames."""
    with torch.no_grad():
        return encoder(TensorDict(observation=frames, batch_size=frames.shape[:-1]))["latent"]


def fit_probe(model: LatentModel, system: System, settings: Settings) -> LinearProbe:
    """A linear probe of the signal from few labelled frames."""
    frames, signals = (system.data[key].flatten(0, 1) for key in ("observation", "signal"))
    step = len(frames) // settings.labels
    latents, signals = encode(model.encoder, frames[::step]), signals[::step]
    return linear_probe(latents, signals, latents, signals)


def probed_metric(model: LatentModel, system: System, plane: Tensor, settings: Settings) -> Metric:
    """Units from labelled frames: |W z - W z_g|^2 estimates |s - g|^2."""
    probe = fit_probe(model, system, settings)
    weight, bias = probe.weight, probe.bias
    to_plane = plane.mT @ weight
    with torch.no_grad():
        p = model.predictor.dist(torch.zeros(4), torch.zeros(2))
    noise = (to_plane @ torch.diag(p.variance.double()) @ to_plane.mT).diagonal().mean().sqrt().item()
    covariance = 0.5 * torch.linalg.inv(weight.mT @ weight)
    return Metric(covariance.float(), (to_plane.float(), (plane.mT @ bias).float()), noise)


def unlabelled_metric(model: LatentModel, system: System, labelled: Metric) -> Metric:
    """Units from the errors of predictions: the signal moves alike in all directions when left alone.

    Their covariance in the latent is that of a noise whose standard deviation in the signal is known (0.1).
    """
    latent, after = (
        encode(model.encoder, system.data[key]) for key in ("observation", ("next", "observation"))
    )
    with torch.no_grad():
        error = (after - model.predictor.dist(latent, system.data["action"]).mean).flatten(0, 1)
    covariance = error.mT @ error / len(error)
    return labelled._replace(covariance=0.5 * covariance / 0.1**2)


def distance_metric(model: LatentModel, system: System, plane: Tensor, settings: Settings) -> Metric:
    """Squared Euclidean distance in the latent, as JEPA world models use it, with one scale for all of it."""
    metric = probed_metric(model, system, plane, settings)
    scale = metric.covariance.diagonal().mean()
    return Metric(scale * torch.eye(4), metric.plane, 0.0)


def make_prior(target_encoder: TensorDictModuleBase, metric: Metric, settings: Settings) -> ProductPrior:
    """All tasks at once: a goal seen through the frozen target encoder, and two keep-out regions."""
    root = torch.linalg.cholesky(metric.covariance)

    def around(frame: Tensor) -> Any:
        entries = TensorDict(observation=frame, batch_size=frame.shape[:-1])
        return full_gaussian(target_encoder(entries)["latent"], root)

    disc = Ball(torch.zeros(2), settings.radius + settings.margin * metric.noise)
    regions = [
        RegionPrior(disc, "out", sharpness=settings.sharpness, probe=metric.plane, task_key=key)
        for key in ("obstacle", "second_obstacle")
    ]
    return ProductPrior(GoalPrior(around, task_key="goal"), *regions)


def make_world(model: LatentModel, system: System, **wanted: Any) -> LatentEnv:
    """The imagined world, with a prior and the price of effort, or with a reward head."""
    return LatentEnv(model, action_spec=system.make_env(1, 0).action_spec_unbatched, **wanted)


def make_planner(world: LatentEnv, seed: int, settings: Settings, *, gradient: bool = False) -> Planner:
    """One planner for all tasks."""
    if gradient:
        return GradientMPC(
            world,
            settings.planning_horizon,
            settings.gradient_steps,
            optimizer=functools.partial(torch.optim.Adam, lr=settings.gradient_lr),
            num_starts=2,
            seed=seed,
        )
    return MPPI(
        world,
        planning_horizon=settings.planning_horizon,
        optim_steps=settings.optim_steps,
        num_candidates=settings.num_candidates,
        top_k=settings.top_k,
        temperature=settings.temperature,
        seed=seed,
    )


class Bench:
    """Runs tasks on one system. The noise depends on the task and the episode, not on who plans.

    Args:
        system: the noisy TV.
        tasks: all tasks.
        plane: the plane they lie in.
        settings: of the run.
    """

    def __init__(self, system: System, tasks: Sequence[Task], plane: Tensor, settings: Settings) -> None:
        self.system, self.tasks, self.plane, self.settings = system, tasks, plane, settings
        self.place = {task.name: k for k, task in enumerate(tasks)}

    def of(self, *families: str) -> list[Task]:
        """The tasks of some families."""
        return [task for task in self.tasks if task.name.rsplit("-", 1)[0] in families]

    def rows(self, tasks: Sequence[Task]) -> list[Task]:
        """One row for each episode of each task."""
        return [task for task in tasks for _ in range(self.settings.episodes)]

    def env(self, tasks: Sequence[Task]) -> BatchedNoisyTVEnv:
        """Fresh noise for tasks that follow each other in the list of all tasks."""
        first, count = self.place[tasks[0].name], self.settings.episodes
        seed = 100_000 + 1_000 * self.system.seed + first * count
        return self.system.make_env(len(tasks) * count, seed)

    def run(self, model: LatentModel, planner: Planner, tasks: Sequence[Task]) -> TensorDict:
        """All episodes of all tasks as one batch."""
        policy = TensorDictSequential(
            Tell(self.rows(tasks), self.settings.planning_horizon), model.encoder, planner
        )
        env = TransformedEnv(self.env(tasks), StepCounter())
        for transform in get_env_transforms_from_module(policy):
            env.append_transform(transform)
        with torch.no_grad():
            return env.rollout(self.settings.steps, policy).select("action", ("next", "signal"))

    def oracle(
        self,
        tasks: Sequence[Task],
        state: Callable[[Tensor], Tensor] | None = None,
        goal: Callable[[Tensor], Tensor] | None = None,
    ) -> TensorDict:
        """The same episodes under the optimal controller.

        Args:
            tasks: the tasks.
            state: what tells the signal from a frame, in place of the Kalman filter.
            goal: what tells it from the frame of the goal, in place of the truth.
        """
        if goal is not None:
            tasks = [replace(task, reference=goal(task.film)) for task in tasks]
        return run_oracle(self.env(tasks), references(self.rows(tasks), self.settings.steps), state)

    def judge(self, tasks: Sequence[Task], episodes: TensorDict) -> list[tuple[float, float]]:
        """Mean cost of a step and share of steps in a region, for each task."""
        rows = self.rows(tasks)
        costs = stage_costs(episodes, references(rows, self.settings.steps))
        regions = torch.stack([task.regions for task in rows])
        inside = violations(episodes, regions, self.plane, self.settings.radius).double()
        both = (values.reshape(len(tasks), -1).mean(1).tolist() for values in (costs, inside))
        return list(zip(*both, strict=True))


class Frozen:
    """Checks that modules stay as they are, bit for bit.

    Args:
        *modules: the modules.
    """

    def __init__(self, *modules: torch.nn.Module) -> None:
        self.modules = modules
        self.before = [copy.deepcopy(module.state_dict()) for module in modules]

    def check(self) -> None:
        """Raise if a parameter or buffer has changed."""
        for module, before in zip(self.modules, self.before, strict=True):
            now = module.state_dict()
            changed = [key for key in before if not torch.equal(before[key], now[key])]
            if changed or now.keys() != before.keys():
                raise RuntimeError(f"tasks must leave the model as it is, but these have changed: {changed}")


def swap_times(model: Trained, bench: Bench, metric: Metric, settings: Settings) -> list[float]:
    """Milliseconds from a new task to the first call of the objective: write the entries, encode the goal."""
    prior = make_prior(model.target_encoder, metric, settings)
    world = make_world(model.model, bench.system, prior=prior, cost=EFFORT * action_cost())
    state = TensorDict(latent=torch.zeros(1, settings.latent_dim), batch_size=[1])
    times = []
    with torch.no_grad():
        for _ in range(20):
            for task in bench.tasks:
                frame, regions = task.film[:1], task.regions.float().unsqueeze(0)
                begin = time.perf_counter()
                state["goal"], state["obstacle"], state["second_obstacle"] = frame, *regions.unbind(1)
                prior(world.planning_state(state)["tasks"])
                times.append(1e3 * (time.perf_counter() - begin))
    return times


def reward_of(task: Task, data: TensorDict) -> TensorDict:
    """The random steps, with the rewards that a goal would have paid."""
    reward = -stage_costs(data, task.reference[0]).unsqueeze(-1).float()
    out = data.select("observation", "action", ("next", "done"))
    return out.set(("next", "reward"), reward)


def continual(
    vjepa: Trained, metric: Metric, bench: Bench, settings: Settings
) -> tuple[list[Row], dict[str, float]]:
    """The first of ten tasks, before and after the other nine: priors, and a model that is fine-tuned."""
    system, seed = bench.system, bench.system.seed
    tasks, _ = make_tasks(
        system.make_env(1, 0), seed + 1, goals=settings.continual_tasks, period=1,
        radius=settings.radius, gap=settings.gap, frames=settings.goal_frames,
    )  # fmt: skip
    own = Bench(system, tasks[1 : settings.continual_tasks + 1], bench.plane, settings)
    first = own.tasks[:1]
    ((oracle, _),) = own.judge(first, own.oracle(first))
    rows: list[Row] = []

    def note(after: int, method: str, cost: float) -> None:
        rows.append(as_row(f"continual-0-after-{after}", method, seed, cost, oracle, 0.0))

    last = settings.continual_tasks - 1
    prior = make_prior(vjepa.target_encoder, metric, settings)
    planner = make_planner(
        make_world(vjepa.model, system, prior=prior, cost=EFFORT * action_cost()), seed, settings
    )
    for after in (0, last):
        planner.set_seed(seed)
        note(after, "bjepa", own.judge(first, own.run(vjepa.model, planner, first))[0][0])
        if after == 0:
            own.run(vjepa.model, planner, own.tasks[1:])

    model = copy.deepcopy(vjepa.model)
    head = QuadraticReward(settings.latent_dim, 2)
    reward_model = TensorDictModule(head, in_keys=["latent", "action"], out_keys=["reward"])
    first_head = None
    for k, task in enumerate(own.tasks):
        data = reward_of(task, system.data)
        finetune(model, reward_model, data, seed, settings)
        if k == 0:
            first_head = copy.deepcopy(reward_model)
        if k in (0, last):
            heads = {"finetuned": reward_model, "finetuned-kept-head": first_head}
            for method, reward in list(heads.items())[: 1 if k == 0 else 2]:
                planner = make_planner(make_world(model, system, reward_model=reward), seed, settings)
                note(k, method, own.judge(first, own.run(model, planner, first))[0][0])
    # The task it was trained on last: it has not merely lost the ability to learn.
    planner = make_planner(make_world(model, system, reward_model=reward_model), seed, settings)
    current = own.tasks[last:]
    ratio = (
        own.judge(current, own.run(model, planner, current))[0][0]
        / own.judge(current, own.oracle(current))[0][0]
    )
    return rows, {"finetuned_on_its_last_task": ratio}


def finetune(
    model: LatentModel, reward_model: TensorDictModule, data: TensorDict, seed: int, settings: Settings
) -> None:
    """Encoder, predictor and reward head together on the reward of one task."""
    loss = RewardLoss(model, reward_model, train_model=True)
    torch.manual_seed(seed)
    # The head alone first, whose problem is convex: else large errors would tear at the encoder.
    solver = torch.optim.LBFGS(reward_model.parameters(), max_iter=100, line_search_fn="strong_wolfe")
    frozen_loss = RewardLoss(model, reward_model)

    def closure() -> Tensor:
        solver.zero_grad()
        value = frozen_loss(data)["loss_reward"]
        value.backward()
        return value

    solver.step(closure)
    optimizer = torch.optim.Adam(loss.parameters(), lr=settings.finetune_lr)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, settings.finetune_lr, total_steps=settings.finetune_steps
    )
    for _ in range(settings.finetune_steps):
        optimizer.zero_grad()
        loss(data[torch.randint(len(data), (8,))])["loss_reward"].backward()
        optimizer.step()
        schedule.step()


def as_row(task: str, method: str, seed: int, cost: float, oracle_cost: float, inside: float) -> Row:
    """One row of the report."""
    return {
        "task": task,
        "method": method,
        "seed": seed,
        "cost": cost,
        "oracle_cost": oracle_cost,
        "ratio": cost / oracle_cost,
        "violations": inside,
    }


class Result(NamedTuple):
    """What a seed gives."""

    rows: list[Row]
    diagnostics: Row
    swap_ms: list[float]
    bench: Bench
    episodes: dict[str, TensorDict]


def run_seed(seed: int, settings: Settings) -> Result:
    """Train once; then only plan."""
    system = System.collect(seed, NOISE_SCALE, settings)
    env = system.make_env(1, 0)
    tasks, plane = make_tasks(
        env, seed, goals=settings.goals, period=settings.period,
        radius=settings.radius, gap=settings.gap, frames=settings.goal_frames,
    )  # fmt: skip
    bench = Bench(system, tasks, plane, settings)
    (vjepa,) = train_restarts(
        f"seed {seed}: train {{}} VJEPA", make_vjepa, vjepa_loss, lambda x: x["mutual_information"], [system],
        settings,
    )  # fmt: skip
    (jepa,) = train_restarts(
        f"seed {seed}: train {{}} JEPA", make_jepa, jepa_loss, lambda x: -objective(x), [system], settings
    )
    recalibrate(vjepa.model, system.data)
    frozen = Frozen(*vjepa, *jepa)
    metric = probed_metric(vjepa.model, system, plane, settings)
    probe = fit_probe(vjepa.model, system, settings)

    goals, circle = bench.of("goal"), bench.of("circle")
    effort = EFFORT * action_cost()

    def see(encoder: TensorDictModuleBase) -> Callable[[Tensor], Tensor]:
        return lambda frames: probe.predict(encode(encoder, frames))

    def world_of(trained: Trained, own: Metric) -> LatentEnv:
        prior = make_prior(trained.target_encoder, own, settings)
        return make_world(trained.model, system, prior=prior, cost=effort)

    world = world_of(vjepa, metric)
    free = world_of(vjepa, unlabelled_metric(vjepa.model, system, metric))
    distance = world_of(jepa, distance_metric(jepa.model, system, plane, settings))
    runs: dict[str, tuple[Sequence[Task], Callable[[], TensorDict]]] = {
        "lqg": (tasks, lambda: bench.oracle(tasks)),
        "lqg-seen-goal": (goals, lambda: bench.oracle(goals, goal=see(vjepa.target_encoder))),
        "lqg-seen-state": (goals, lambda: bench.oracle(goals, state=see(vjepa.model.encoder))),
        "bjepa": (tasks, lambda: bench.run(vjepa.model, make_planner(world, seed, settings), tasks)),
        "bjepa-gradient": (
            tasks,
            lambda: bench.run(vjepa.model, make_planner(world, seed, settings, gradient=True), tasks),
        ),
        "bjepa-unlabelled": (
            [*circle, *goals],
            lambda: bench.run(vjepa.model, make_planner(free, seed, settings), [*circle, *goals]),
        ),
        "retrained": (
            goals,
            lambda: torch.cat(
                [
                    bench.run(
                        vjepa.model,
                        make_planner(
                            make_world(
                                vjepa.model,
                                system,
                                reward_model=train_reward(vjepa.model, system, reward_of(task, system.data)),
                            ),
                            seed,
                            settings,
                        ),
                        [task],
                    )
                    for task in goals
                ]
            ),
        ),
        "jepa": (tasks, lambda: bench.run(jepa.model, make_planner(distance, seed, settings), tasks)),
    }
    episodes: dict[str, TensorDict] = {}
    seconds: dict[str, float] = {}
    progress = tqdm(runs.items(), leave=False)
    for method, (_, run) in progress:
        progress.set_description(f"seed {seed}: {METHODS[method]}")
        begin = time.perf_counter()
        episodes[method] = run()
        seconds[method] = time.perf_counter() - begin
    paid = bench.judge(tasks, episodes["lqg"])
    oracle = {task.name: cost for task, (cost, _) in zip(tasks, paid, strict=True)}
    rows = [
        as_row(task.name, method, seed, cost, oracle[task.name], inside)
        for method, (own, _) in runs.items()
        for task, (cost, inside) in zip(own, bench.judge(own, episodes[method]), strict=True)
    ]
    rows += unconstrained(bench, episodes["bjepa"], oracle)
    more, extra = continual(vjepa, metric, bench, settings)
    rows += more
    swap_ms = swap_times(vjepa, bench, metric, settings)
    frozen.check()
    error = torch.cat([see(vjepa.target_encoder)(task.film[:1]) - task.reference[:1] for task in goals])
    diagnostics = {
        "seed": seed,
        "goal_error": error.square().sum(-1).mean().sqrt().item(),
        "noise": metric.noise,
        "seconds": seconds,
        **extra,
    }
    return Result(rows, diagnostics, swap_ms, bench, episodes)


def unconstrained(bench: Bench, episodes: TensorDict, oracle: dict[str, float]) -> list[Row]:
    """How often the same planner is in the regions when nobody tells it of them: on the goal tasks."""
    count = bench.settings.episodes
    rows = []
    for task in bench.of("keep-out", "two-regions"):
        goal = "goal-" + task.name.rsplit("-", 1)[1]
        place = bench.place[goal] * count
        ((cost, inside),) = bench.judge([task], episodes[place : place + count])
        name = "bjepa-unconstrained"
        rows.append(as_row(task.name, name, bench.system.seed, cost, oracle[goal], inside))
    return rows


def table(rows: Sequence[Row]) -> str:
    """Cost as a multiple of the optimal controller's (mean over tasks, worst seed), and steps in regions."""
    seeds = sorted({row["seed"] for row in rows})
    lines = [
        f"{'task':22s}{'method':32s}{'cost':>9s}{'x LQG':>9s}{'worst':>9s}{'in region':>11s}{'worst':>9s}"
    ]
    families = [*FAMILIES, *dict.fromkeys(r["task"] for r in rows if r["task"].startswith("continual"))]
    for family in families:
        of_family = [row for row in rows if row["task"] == family or row["task"].rsplit("-", 1)[0] == family]
        for method in dict.fromkeys(row["method"] for row in of_family):
            here = [[r for r in of_family if (r["method"], r["seed"]) == (method, s)] for s in seeds]
            ratios = [mean(r["ratio"] for r in one) for one in here]
            inside = [mean(r["violations"] for r in one) for one in here]
            cost = mean(r["cost"] for one in here for r in one)
            line = f"{family:22s}{METHODS[method]:32s}{cost:9.3f}{mean(ratios):9.3f}{max(ratios):9.3f}"
            if family in ("keep-out", "two-regions"):
                line += f"{mean(inside):11.2%}{max(inside):9.2%}"
            lines.append(line)
        lines.append("")
    return "\n".join(lines).rstrip()


def figure(result: Result, path: Path) -> None:
    """Where the signal goes in the plane of the goals."""
    bench, settings = result.bench, result.bench.settings
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    fig, axes = plt.subplots(1, 4, figsize=(15, 4.1), layout="constrained", sharex=True, sharey=True)
    places = {
        name: episodes["next", "signal"].double() @ bench.plane for name, episodes in result.episodes.items()
    }
    titles = (
        "Goals, each shown as one noisy frame",
        "A region to keep out of, for each goal",
        "Two regions, for each goal",
        f"A circle in {settings.period} steps, shown as a film",
    )
    for ax, family, title in zip(axes, FAMILIES, titles, strict=True):
        tasks = bench.of(family)
        if family in ("keep-out", "two-regions"):
            tasks = tasks[::2]  # all of them would hide each other
        for k, task in enumerate(tasks):
            row = bench.place[task.name] * settings.episodes
            color = COLORS[k % len(COLORS)]
            path_of = places["bjepa"][row]
            goal = task.reference @ bench.plane
            if family == "circle":
                ax.plot(
                    *torch.cat([goal, goal[:1]]).T, color="0.3", ls="--", lw=1, label="where it should be"
                )
                ax.plot(*path_of[-2 * settings.period :].T, color=color, lw=0.8, label="true signal, BJEPA")
                ax.plot(
                    *places["lqg"][row, -settings.period :].T,
                    color="black",
                    lw=0.8,
                    ls=":",
                    label="optimal controller",
                )
                ax.legend(loc="upper right", frameon=False)
                continue
            ax.plot(*path_of.T, color=color, lw=0.5, alpha=0.35)
            ax.plot(*path_of[10:].T, color=color, ls="", marker=".", ms=2.5, zorder=3)
            ax.plot(
                *goal[0],
                color="black",
                marker="x",
                ls="",
                ms=7,
                mew=1.8,
                zorder=5,
                label="goal" if k == 0 else None,
            )
            for centre in task.regions:
                if centre.abs().max() < NOWHERE / 2:
                    ax.add_patch(
                        plt.Circle(
                            centre.tolist(), settings.radius, fill=False, color=color, hatch="////", lw=1.2
                        )
                    )
        if family == "goal":
            ax.plot([], [], color="0.4", ls="", marker=".", label="true signal, BJEPA (after 10 steps)")
            ax.legend(loc="upper right", frameon=False)
        ax.set(title=title, xlabel="signal, first direction of the plane", aspect="equal")
    axes[0].set(ylabel="signal, second direction of the plane", xlim=(-1.9, 1.9), ylim=(-1.9, 1.9))
    fig.savefig(path, dpi=150)
    plt.close(fig)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, print the table, draw the figure, write the JSON."""
    settings, args = read_settings(command_line(Settings, __doc__), Settings, QUICK, arguments)
    prepare(args)
    start = time.perf_counter()
    results = [run_seed(seed, settings) for seed in settings.seeds]
    wall = time.perf_counter() - start
    rows = [row for result in results for row in result.rows]
    swap_ms = median(value for result in results for value in result.swap_ms)
    print(table(rows))
    path = args.out / "goal_swap.png"
    figure(results[0], path)
    print(f"\nA task is swapped in {swap_ms:.2f} ms (median); the model is bit for bit as it was trained.")
    print(f"{wall:.0f} s; figure: {path}")
    write_report(
        args,
        settings,
        wall_s=wall,
        swap_ms=swap_ms,
        rows=rows,
        diagnostics=[result.diagnostics for result in results],
    )


if __name__ == "__main__":
    main()
