"""Planning speed: CEM and MPPI against TorchRL's and against the same arithmetic without any library.

Everything plans over the same network and cost with the same candidates, horizon and iterations, in one
process, on one thread, in turn; time is processor time, and a ratio is the median of the ratios within the
rounds. Before anything is timed, the plans are compared: the floor (a hand-written loop, sampling included)
must give the very plan of the library, TorchRL's planners the same optimum. "products" are the matrix
products of a plan alone. With "one by one", environments are planned for one after another; "chunked"
imagines a quarter of the candidates at a time, "half" draws half of them, "decaying" 0.8 of those of the
round before, "bf16" has LatentEnv(rollout_dtype=torch.bfloat16), "short" three quarters of the iterations
besides (see planner_quality.py for what that costs), "compiled" the default torch.compile; all against the
full floor. pytorch_mppi joins where it is installed (the extra "benchmarks"),
over the network and the cost of the floor.
"""

from __future__ import annotations

import importlib
import importlib.util
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Bounded
from torchrl.modules import CEMPlanner, MPPIPlanner
from tqdm import tqdm

from _floor import MIN_STD, TEMPERATURE, Floor
from _memory import peak
from torchrl_vjepa import CEM, MPPI, LatentEnv, Predictor
from torchrl_vjepa.costs import action_cost, quadratic_cost

sys.path.append(str(Path(__file__).resolve().parents[1] / "examples"))
_settings = importlib.import_module("_settings")
option = _settings.option

Call = Callable[[], Any]
#: candidates, horizon, latent, width, action
SIZES = {"tiny": (64, 10, 8, 64, 2), "medium": (512, 15, 32, 256, 4), "wide": (4096, 30, 64, 512, 4)}
PLANNERS = (
    "CEM",
    "MPPI",
    "CEM one by one",
    "CEM chunked",
    "CEM half",
    "CEM decaying",
    "CEM bf16",
    "CEM bf16 short",
    "CEM compiled",
    "TorchRL CEM",
    "TorchRL MPPI",
    "pytorch_mppi",
    "floor CEM",
    "floor MPPI",
    "products",
)
BOUND, EFFORT = 2.0, 0.1
#: Of pytorch_mppi, in units of the cost: small enough to find the optimum in the check below.
PEER_TEMPERATURE = 0.05
#: Multiplications of one plan beyond which a combination is left out: minutes, and nothing new.
MAX_PRODUCTS = 2.5e11
#: Iterations after which plans of different planners are compared: the optimum, not how soon it is reached.
CONVERGED = 12


@dataclass
class Settings:
    """What is measured."""

    sizes: list[str] = option(list(SIZES), "sizes of the problem", choices=list(SIZES))
    num_envs: list[int] = option([1, 16, 256], "environments that are planned for at once")
    planners: list[str] = option(
        [name for name in PLANNERS if name != "CEM compiled"],  # takes half a minute to compile
        "what is measured; floors always are",
        choices=list(PLANNERS),
        metavar="PLANNER",
    )
    optim_steps: int = option(4, "iterations of a plan")
    rounds: int = option(9, "interleaved rounds, at most")
    round_ms: float = option(50.0, "time that the floor takes in a round, at least, in milliseconds")
    budget_s: float = option(60.0, "time for the rounds of one size and number of environments, in seconds")
    seed: int = option(0, "of weights, states and plans")


QUICK = {"sizes": ["tiny"], "num_envs": [1, 16], "rounds": 1, "round_ms": 0.0}


class SummedReward(TensorDictModuleBase):
    """The advantage of TorchRL's MPPI: the summed reward, the same at each step; no value network."""

    in_keys = [("next", "reward")]
    out_keys = ["advantage"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the sum."""
        reward = tensordict.get(("next", "reward"))
        return tensordict.set("advantage", reward.sum(-2, keepdim=True).expand_as(reward))


class Problem:
    """A network, a cost, states, and all planners over them."""

    def __init__(self, size: str, num_envs: int, optim_steps: int, seed: int) -> None:
        self.candidates, self.horizon, latent, width, self.action = SIZES[size]
        self.num_envs, self.optim_steps, self.seed = num_envs, optim_steps, seed
        self.top_k = self.candidates // 8
        torch.manual_seed(seed)
        self.predictor = Predictor(latent, self.action, trunk="mlp", num_cells=(width, width))
        with torch.no_grad():  # gains at which latents neither die out nor explode
            for layer in (0, 2, 4):
                self.predictor.trunks[0][layer].weight.mul_(2.0)
        self.goal = torch.randn(latent)
        self.start = torch.randn(num_envs, latent)
        self.env = self.make_env()
        self.inputs = torch.randn(num_envs * self.candidates, latent + self.action)

    def make_env(self, **kwargs: Any) -> LatentEnv:
        """The network and the cost as an environment."""
        return LatentEnv(
            self.predictor,
            action_spec=Bounded(-BOUND, BOUND, (self.action,)),
            cost=quadratic_cost(self.goal) + EFFORT * action_cost(),
            **kwargs,
        )

    @property
    def multiplications(self) -> float:
        """Of one plan."""
        weights = sum(weight.numel() for weight, _ in self.floor("cem").layers)
        return float(weights * self.num_envs * self.candidates * self.horizon * self.optim_steps)

    def floor(self, kind: Any) -> Floor:
        """The hand-written loop."""
        inputs = self.start.shape[1] + self.action
        first, second, last = (self.predictor.trunks[0][layer] for layer in (0, 2, 4))
        half = self.start.shape[1]
        layers = [
            (first.weight[:, :inputs], first.bias + first.weight[:, inputs]),
            (second.weight, second.bias),
            (last.weight[:half], last.bias[:half]),
        ]
        layers = [(weight.detach(), bias.detach()) for weight, bias in layers]
        return Floor(
            layers, self.goal, EFFORT, BOUND, self.action, self.horizon, self.candidates,
            self.optim_steps, self.top_k, kind,
        )  # fmt: skip

    def ours(self, cls: type[CEM | MPPI], optim_steps: int | None = None, **kwargs: Any) -> CEM | MPPI:
        """The library's planner with the settings that all share."""
        if cls is MPPI:
            kwargs = {"temperature": TEMPERATURE, **kwargs}
        return cls(
            kwargs.pop("env", self.env),
            self.horizon,
            optim_steps or self.optim_steps,
            kwargs.pop("candidates", self.candidates),
            self.top_k,
            min_std=MIN_STD,
            seed=self.seed,
            **kwargs,
        )

    def theirs(self, name: str, optim_steps: int | None = None) -> CEMPlanner | MPPIPlanner:
        """TorchRL's planner with the same settings; its temperature multiplies."""
        given = {
            "planning_horizon": self.horizon,
            "optim_steps": optim_steps or self.optim_steps,
            "num_candidates": self.candidates,
            "top_k": self.top_k,
        }
        if name == "TorchRL CEM":
            return CEMPlanner(self.env, **given)
        return MPPIPlanner(self.env, SummedReward(), temperature=1.0, **given)

    def pytorch_mppi(self, optim_steps: int | None = None) -> Call:
        """The planner of pytorch_mppi: one command for every iteration, the plan kept in between.

        Its network and cost are the bare ones of the floor: what is measured is the planner. Its spread stays
        what it is, and its temperature is in units of the cost.
        """
        module = importlib.import_module("pytorch_mppi")
        floor = self.floor("mppi")
        (w1, b1), (w2, b2), (w3, b3) = floor.layers

        def dynamics(state: Tensor, action: Tensor) -> Tensor:
            hidden = F.silu(F.linear(torch.cat([state, action], -1), w1, b1), inplace=True)
            return F.linear(F.silu(F.linear(hidden, w2, b2), inplace=True), w3, b3)

        def cost(state: Tensor, action: Tensor) -> Tensor:
            return (state - self.goal).square().sum(-1) + EFFORT * action.square().sum(-1)

        spread = torch.eye(self.action) * (0.5 * BOUND) ** 2
        given = {
            "num_samples": self.candidates,
            "horizon": self.horizon,
            "lambda_": PEER_TEMPERATURE,
            "u_min": torch.full((self.action,), -BOUND),
            "u_max": torch.full((self.action,), BOUND),
        }
        latent = self.start.shape[1]
        if self.num_envs == 1:
            planner = module.MPPI(dynamics, cost, latent, spread, **given)
        else:
            planner = module.MPPI_Batched(dynamics, cost, latent, spread, self.num_envs, **given)
        start = self.start[0] if self.num_envs == 1 else self.start

        def call() -> Tensor:
            planner.reset()
            for _ in range(optim_steps or self.optim_steps):
                action = planner.command(start, shift_nominal_trajectory=False)
            return action

        return call

    def data(self, rows: slice = slice(None)) -> TensorDict:
        """What a policy is called with."""
        start = self.start[rows]
        return TensorDict(latent=start, batch_size=len(start))

    def call(self, name: str) -> Call | None:
        """One plan for all environments; ``None`` where the planner does not apply."""
        if name in ("CEM", "MPPI"):
            planner = self.ours({"CEM": CEM, "MPPI": MPPI}[name])
            return lambda: planner(self.data())
        if name == "CEM one by one":
            planner = self.ours(CEM)
            rows = [slice(row, row + 1) for row in range(self.num_envs)]
            return None if len(rows) == 1 else lambda: [planner(self.data(row)) for row in rows]
        if name.startswith("CEM "):
            planner = self.lever(name.removeprefix("CEM "))
            return lambda: planner(self.data())
        if name.startswith("TorchRL"):
            stock = self.theirs(name)
            return lambda: stock(self.data())
        if name == "pytorch_mppi":
            return self.pytorch_mppi() if importlib.util.find_spec(name) is not None else None
        floor = self.floor("mppi" if name == "floor MPPI" else "cem")
        if name == "products":
            return lambda: floor.products(self.start, self.inputs)
        generator = torch.Generator().manual_seed(self.seed)
        return lambda: floor.plan(self.start, generator)

    def lever(self, name: str) -> CEM | MPPI:
        """The library's CEM with what makes it cheaper."""
        if name == "chunked":
            return self.ours(CEM, chunk_size=self.candidates // 4)
        if name == "compiled":
            return self.ours(CEM, compile=True)
        if name == "half":
            return self.ours(CEM, candidates=self.candidates // 2)
        if name == "decaying":
            return self.ours(CEM, population_decay=0.8)
        rounds = max(1, 3 * self.optim_steps // 4) if name == "bf16 short" else None
        return self.ours(CEM, rounds, env=self.make_env(rollout_dtype=torch.bfloat16))

    def check(self) -> None:
        """The floor gives the library's plan, TorchRL's planners an action of the same cost."""
        for cls, kind in ((CEM, "cem"), (MPPI, "mppi")):
            planner = self.ours(cls)
            generator = torch.Generator().manual_seed(0)
            generator.set_state(planner.generator.get_state())
            ours = planner(self.data())["next", "plan"]
            floor = self.floor(kind).plan(self.start, generator)
            floor = torch.cat([floor[:, 1:], floor[:, -1:]], 1)
            # Rounding may move the border of the elites.
            if (ours - floor).abs().gt(1e-2).float().mean() > 1e-2:
                raise AssertionError(f"{kind}: library and floor do not give the same plan")


def check_optimum(size: str, seed: int) -> None:
    """All planners find the same first action, with enough iterations: of a horizon of one step."""
    problem = Problem(size, 2, CONVERGED, seed)
    problem.horizon = 1
    problem.candidates, problem.top_k = 256, 32
    reached = {}
    calls: dict[str, Any] = {"CEM": problem.ours(CEM), "MPPI": problem.ours(MPPI)}
    calls |= {name: problem.theirs(name) for name in ("TorchRL CEM", "TorchRL MPPI")}
    for name, planner in calls.items():
        torch.manual_seed(seed)
        action = planner(problem.data())["action"]
        reached[name] = problem.env.objective(problem.start, action[:, None, None, :]).squeeze(1)
    if importlib.util.find_spec("pytorch_mppi") is not None:
        torch.manual_seed(seed)
        action = problem.pytorch_mppi()()
        reached["pytorch_mppi"] = problem.env.objective(problem.start, action[:, None, None, :]).squeeze(1)
    for name, cost in reached.items():
        torch.testing.assert_close(
            cost, reached["CEM"], rtol=2e-2, atol=1e-3, msg=lambda m, n=name: f"{n}: {m}"
        )


@torch.no_grad()
def measure(size: str, num_envs: int, settings: Settings) -> list[dict[str, Any]]:
    """Interleaved rounds of all planners on one problem."""
    problem = Problem(size, num_envs, settings.optim_steps, settings.seed)
    problem.check()
    calls = {}
    for name in PLANNERS:
        call = problem.call(name) if name in settings.planners or name.startswith("floor") else None
        if call is not None:
            calls[name] = call
    cost = {}
    for name, call in calls.items():  # warms up, and says how long a round takes
        cost[name] = seconds(call, 1)
    repeats = {
        name: max(1, min(50, round(settings.round_ms / 1e3 / max(s, 1e-5)))) for name, s in cost.items()
    }
    once = sum(cost[name] * repeats[name] for name in calls)
    rounds = max(1, min(settings.rounds, int(settings.budget_s / once)))
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            times[name].append(seconds(call, repeats[name]))
    rows = []
    for name in calls:
        floor = times["floor MPPI" if name.endswith(("MPPI", "mppi")) else "floor CEM"]
        rows.append(
            {
                "size": size,
                "num_envs": num_envs,
                "planner": name,
                "ms_per_plan": 1e3 * statistics.median(times[name]),
                "ratio_to_floor": statistics.median(a / b for a, b in zip(times[name], floor, strict=True)),
                "peak_mb": peak(calls[name]) / 1e6,
                "rounds": rounds,
            }
        )
    return rows


def seconds(call: Call, repeats: int) -> float:
    """Processor time of a call."""
    start = time.process_time()
    for _ in range(repeats):
        call()
    return (time.process_time() - start) / repeats


def table(rows: Sequence[dict[str, Any]]) -> str:
    """One line for each measurement."""
    lines = [f"{'size':8s}{'envs':>5s}  {'planner':16s}{'ms/plan':>11s}{'x floor':>9s}{'peak MB':>9s}"]
    for row in rows:
        lines.append(
            f"{row['size']:8s}{row['num_envs']:5d}  {row['planner']:16s}{row['ms_per_plan']:11.2f}"
            f"{row['ratio_to_floor']:9.2f}{row['peak_mb']:9.2f}"
        )
    return "\n".join(lines)


def draw(rows: Sequence[dict[str, Any]], folder: Path) -> None:
    """Ratios to the floor, one panel for each size."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    sizes = list(dict.fromkeys(row["size"] for row in rows))
    names = [n for n in PLANNERS if not n.startswith("floor") and any(r["planner"] == n for r in rows)]
    fig, axes = plt.subplots(
        1, len(sizes), figsize=(3.6 * len(sizes), 3.6), layout="constrained", squeeze=False
    )
    colors = ("#0072B2", "#E69F00", "#009E73")
    for ax, size in zip(axes[0], sizes, strict=True):
        here = [row for row in rows if row["size"] == size]
        counts = list(dict.fromkeys(row["num_envs"] for row in here))
        for i, count in enumerate(counts):
            ratios = {row["planner"]: row["ratio_to_floor"] for row in here if row["num_envs"] == count}
            height = 0.8 / len(counts)
            places = [k + (i - (len(counts) - 1) / 2) * height for k, n in enumerate(names) if n in ratios]
            values = [ratios[n] for n in names if n in ratios]
            ax.barh(
                places, values, height, color=colors[i % 3], label=f"{count} env{'s' if count > 1 else ''}"
            )
        ax.axvline(1.0, color="black", ls="--", lw=1)
        ax.set(xscale="log", xlabel="time / time of the bare loop", title=size)
        ax.set_yticks(range(len(names)), names)
        ax.invert_yaxis()
        ax.legend(frameon=False, fontsize=8)
    fig.savefig(folder / "planners_speed.png", dpi=150)
    plt.close(fig)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print the table, write JSON and figure."""
    parser = _settings.command_line(Settings, __doc__)
    settings, args = _settings.read_settings(parser, Settings, QUICK, arguments)
    _settings.prepare(args)
    start = time.perf_counter()
    rows, left_out = [], []
    work = [(size, num) for size in settings.sizes for num in settings.num_envs]
    for size in settings.sizes:
        check_optimum(size, settings.seed)
    for size, num_envs in tqdm(work, leave=False):
        if Problem(size, num_envs, settings.optim_steps, settings.seed).multiplications > MAX_PRODUCTS:
            left_out.append(f"{size} x {num_envs}")
            continue
        rows += measure(size, num_envs, settings)
    print(table(rows))
    if left_out:
        print(f"left out, more than {MAX_PRODUCTS:.1g} multiplications a plan: {', '.join(left_out)}")
    if importlib.util.find_spec("pytorch_mppi") is None:
        print('pytorch_mppi is not installed (the extra "benchmarks"): not measured')
    draw(rows, args.out)
    _settings.write_report(args, settings, wall_s=time.perf_counter() - start, rows=rows)


if __name__ == "__main__":
    main()
