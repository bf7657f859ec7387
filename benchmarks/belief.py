"""Beliefs: rollout, moments and particle filter against their bare tensor arithmetic, and how they grow.

Both sides of a ratio compute the same numbers from the same weights (compared before anything is timed),
in one process, in turn, on one thread; time is processor time. Both sides of ``moments_linearize`` take the
Jacobian by automatic differentiation: by hand, for the one network at hand, it costs about a third. Memory
is the peak of what is allocated during a call. Growth is the exponent in one size, the others fixed: 1 is
linear.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import torch
import torch.nn.functional as F
from torch import Tensor

from _memory import peak
from torchrl_vjepa import ParticleBelief, ParticleFilter, Predictor, propagate_moments, rollout
from torchrl_vjepa.distributions import soft_clamp

Call = Callable[[], Any]
SIZES = {"batch": 32, "latent": 8, "horizon": 8, "samples": 32, "particles": 1000}
# The batch where a case is compared: as many rows as a planner imagines at once.
BATCH = {"rollout_mean": 4096, "rollout_sample": 128, "moments_linearize": 256, "moments_sigma_points": 256}
WIDTH, ACTION, OBSERVATION = 256, 2, 16


class Problem:
    """An MLP predictor, a linear observation model, and inputs of given sizes."""

    def __init__(self, seed: int, **sizes: int) -> None:
        self.sizes = {**SIZES, **sizes}
        batch, latent, horizon = (self.sizes[name] for name in ("batch", "latent", "horizon"))
        torch.manual_seed(seed)
        self.predictor = Predictor(latent, action_dim=ACTION, trunk="mlp", num_cells=(WIDTH,))
        self.first, self.last = self.predictor.trunks[0][0], self.predictor.trunks[0][-1]
        self.sensor = torch.randn(latent, OBSERVATION)
        self.start = torch.randn(batch, latent)
        self.actions = torch.randn(batch, horizon, ACTION)
        self.observation = torch.randn(batch, OBSERVATION)
        factor = torch.randn(batch, latent, latent) / latent
        self.covariance = factor @ factor.mT + 0.1 * torch.eye(latent)
        self.particles = torch.randn(batch, self.sizes["particles"], latent)
        self.log_weights = torch.randn(batch, self.sizes["particles"]).log_softmax(-1)

    def likelihood(self, observation: Tensor, latent: Tensor) -> Tensor:
        """A Gaussian observation model, a hundred units wide: every particle keeps some weight."""
        return -0.5e-4 * (observation - latent @ self.sensor).square().sum(-1)

    def features(self, latent: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Hidden layer, mean and standard deviation, by hand; the skip's one-hot input is one."""
        one = latent.new_ones(1).expand(*latent.shape[:-1], 1)
        hidden = F.linear(torch.cat([latent, action, one], -1), self.first.weight, self.first.bias)
        mean, log_var = F.linear(F.silu(hidden), self.last.weight, self.last.bias).chunk(2, -1)
        return hidden, mean, (0.5 * soft_clamp(log_var, -16.0, 16.0)).exp()

    # what is compared: name -> (library, bare)

    def rollout_mean(self) -> tuple[Call, Call]:
        """One trajectory a row."""

        def bare() -> Tensor:
            latent, out = self.start, []
            for action in self.actions.unbind(1):
                _, latent, _ = self.features(latent, action)
                out.append(latent)
            return torch.stack(out, 1)

        return lambda: rollout(self.predictor.dist, self.start, self.actions), bare

    def rollout_sample(self) -> tuple[Call, Call]:
        """Monte Carlo trajectories."""
        num = self.sizes["samples"]

        def bare() -> Tensor:
            latent, out = self.start.expand(num, *self.start.shape), []
            for action in self.actions.expand(num, *self.actions.shape).unbind(2):
                _, mean, std = self.features(latent, action)
                latent = torch.normal(mean, std)
                out.append(latent)
            return torch.stack(out, 2)

        return lambda: rollout(self.predictor.dist, self.start, self.actions, "sample", num), bare

    def moments(self, method: Literal["linearize", "sigma_points"]) -> Call:
        """Means and covariances by the library."""
        given = (self.predictor.dist, self.start, self.actions, method)
        return lambda: propagate_moments(*given, covariance=self.covariance)

    def moments_linearize(self) -> tuple[Call, Call]:
        """The extended Kalman prediction."""
        dim = self.sizes["latent"]

        def bare() -> tuple[Tensor, Tensor]:
            mean, covariance, out = self.start, self.covariance, []
            basis = torch.eye(dim).reshape(dim, 1, dim).expand(dim, *mean.shape)
            for action in self.actions.unbind(1):

                def predict(latent: Tensor, action: Tensor = action) -> tuple[Tensor, Tensor]:
                    _, mean, std = self.features(latent, action)
                    return mean, std

                mean, pullback, std = torch.func.vjp(predict, mean, has_aux=True)
                (rows,) = torch.func.vmap(pullback)(basis)
                jacobian = rows.movedim(0, -2)
                covariance = torch.diag_embed(std.square()) + jacobian @ covariance @ jacobian.mT
                out.append((mean, covariance))
            return torch.stack([m for m, _ in out], 1), torch.stack([c for _, c in out], 1)

        return self.moments("linearize"), bare

    def moments_sigma_points(self) -> tuple[Call, Call]:
        """The spherical cubature rule."""
        dim = self.sizes["latent"]

        def bare() -> tuple[Tensor, Tensor]:
            mean, covariance, out = self.start, self.covariance, []
            for action in self.actions.unbind(1):
                offset = dim**0.5 * torch.linalg.cholesky(covariance).movedim(-1, 0)
                points = torch.cat([mean + offset, mean - offset])
                _, means, stds = self.features(points, action.expand(2 * dim, *action.shape))
                mean = means.mean(0)
                spread = (means - mean).movedim(0, -1)
                covariance = torch.diag_embed(stds.square().mean(0)) + spread @ spread.mT / (2 * dim)
                out.append((mean, covariance))
            return torch.stack([m for m, _ in out], 1), torch.stack([c for _, c in out], 1)

        return self.moments("sigma_points"), bare

    def make_filter(self, **kwargs: Any) -> ParticleFilter:
        """The filter that is measured; it resamples every row at every step."""
        return ParticleFilter(
            self.predictor,
            self.likelihood,
            num_particles=self.sizes["particles"],
            resample_threshold=1.0,
            **kwargs,
        )

    def particle_filter(self) -> tuple[Call, Call]:
        """One step: resample, predict, weigh."""
        run = self.make_filter()
        num = self.sizes["particles"]
        action = self.actions[:, 0]

        def bare() -> tuple[Tensor, Tensor]:
            weights = self.log_weights.exp()
            poor = 1 / weights.square().sum(-1, keepdim=True) < num
            start = torch.rand(len(weights), 1)
            cumulative = weights.cumsum(-1)
            positions = (torch.arange(num) + start) / num
            index = torch.searchsorted(cumulative / cumulative[:, -1:], positions, right=True)
            index = torch.where(poor, index.clamp_max(num - 1), torch.arange(num))
            particles = self.particles.gather(1, index.unsqueeze(-1).expand(self.particles.shape))
            log_weights = torch.where(poor, -math.log(num), self.log_weights)
            _, mean, std = self.features(particles, action.unsqueeze(1).expand(-1, num, -1))
            particles = torch.normal(mean, std)
            joint = log_weights + self.likelihood(self.observation.unsqueeze(1), particles)
            evidence = joint.logsumexp(-1)
            return particles, joint - evidence.unsqueeze(-1)

        def library() -> tuple[Tensor, Tensor]:
            belief = ParticleBelief(self.particles, self.log_weights, validate_args=False)
            belief, _ = run.step(belief, action, self.observation)
            return belief.particles, belief.log_weights

        return library, bare


CASES = ("rollout_mean", "rollout_sample", "moments_linearize", "moments_sigma_points", "particle_filter")


@torch.no_grad()
def compare(case: str, rounds: int, calls: int, seed: int) -> dict[str, Any]:
    """Interleaved rounds; medians of times and of their ratios; peaks of memory."""
    batch = BATCH.get(case, SIZES["batch"])
    library, bare = getattr(Problem(seed, batch=batch), case)()
    results = []
    for call in (library, bare):
        torch.manual_seed(1)
        out = call()
        results.append(torch.cat([value.flatten() for value in ((out,) if isinstance(out, Tensor) else out)]))
    # Rounding may move the border between two resampled particles: a few entries may differ.
    if (results[0] - results[1]).abs().gt(1e-3).float().mean() > 1e-3:
        raise AssertionError(f"{case}: the two sides do not compute the same")
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(rounds):
        for call, seconds in zip((library, bare), times, strict=True):
            start = time.process_time()
            for _ in range(calls):
                call()
            seconds.append((time.process_time() - start) / calls)
    return {
        "case": case,
        "batch": batch,
        "library_ms": 1000 * statistics.median(times[0]),
        "bare_ms": 1000 * statistics.median(times[1]),
        "time_ratio": statistics.median(a / b for a, b in zip(*times, strict=True)),
        "library_bytes": peak(library),
        "bare_bytes": peak(bare),
        "memory_ratio": peak(library) / peak(bare),
    }


GROWTH = {
    "rollout_sample": {"samples": (64, 256), "horizon": (8, 32), "batch": (32, 128), "latent": (8, 32)},
    "moments_linearize": {"horizon": (8, 32), "batch": (32, 128), "latent": (8, 32)},
    "moments_sigma_points": {"horizon": (8, 32), "batch": (32, 128), "latent": (8, 32)},
    "particle_filter": {"particles": (1000, 4000), "batch": (32, 128), "latent": (8, 32)},
}


@torch.no_grad()
def grow(case: str, name: str, low: int, high: int, rounds: int, seed: int) -> dict[str, Any]:
    """Exponents of time and memory between two sizes."""
    calls = [getattr(Problem(seed, **{name: size}), case)()[0] for size in (low, high)]
    times: tuple[list[float], list[float]] = ([], [])
    for round_ in range(rounds + 1):
        for call, seconds in zip(calls, times, strict=True):
            start = time.process_time()
            call()
            if round_:  # the first one warms up
                seconds.append(time.process_time() - start)
    factor = math.log(high / low)
    return {
        "case": case,
        "size": name,
        "low": low,
        "high": high,
        "time_exponent": math.log(min(times[1]) / min(times[0])) / factor,
        "memory_exponent": math.log(peak(calls[1]) / peak(calls[0])) / factor,
    }


@torch.no_grad()
def chunk(chunk_size: int | None, seed: int) -> dict[str, Any]:
    """Peak memory beyond the result itself, of many samples and many particles."""
    num = 4096
    problem = Problem(seed, batch=4, particles=num)
    run = problem.make_filter(chunk_size=chunk_size)
    belief = ParticleBelief(problem.particles, problem.log_weights, validate_args=False)

    def sample() -> Tensor:
        return rollout(
            problem.predictor.dist,
            problem.start,
            problem.actions,
            "sample",
            num,
            chunk_size=chunk_size,
        )

    return {
        "chunk_size": chunk_size,
        "rollout_bytes": peak(sample),
        "rollout_result_bytes": sample().nbytes,
        "filter_bytes": peak(lambda: run.step(belief, problem.actions[:, 0], problem.observation)),
    }


def draw(rows: list[dict[str, Any]], chunks: list[dict[str, Any]], folder: Path) -> None:
    """Ratios of time and memory, and what chunks save."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    places = torch.arange(len(rows)).double()
    for shift, key, color in ((-0.2, "time_ratio", "#0072B2"), (0.2, "memory_ratio", "#E69F00")):
        left.bar(places + shift, [row[key] for row in rows], 0.4, color=color, label=key.split("_")[0])
    left.axhline(1.2, color="black", ls="--", lw=1, label="1.2")
    left.set_xticks(places, [row["case"].replace("_", "\n") for row in rows], fontsize=8)
    left.set_ylabel("library / bare tensor arithmetic")
    left.set_ylim(0, 1.7)
    left.legend(frameon=False, ncols=3)
    names = [str(row["chunk_size"] or "all") for row in chunks]
    for key, style in (("rollout_bytes", "o-"), ("filter_bytes", "s--")):
        right.plot(names, [row[key] / 1e6 for row in chunks], style, label=key.split("_")[0])
    right.set(xlabel="chunk_size (samples or particles)", ylabel="peak memory (MB)", yscale="log")
    right.legend(frameon=False)
    folder.mkdir(parents=True, exist_ok=True)
    fig.savefig(folder / "belief.png", dpi=150)
    plt.close(fig)


def main() -> None:
    """Measure, print the tables, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=15, help="interleaved rounds (default: 15)")
    parser.add_argument("--calls", type=int, default=5, help="calls in a round (default: 5)")
    parser.add_argument("--seed", type=int, default=0, help="of weights and inputs (default: 0)")
    parser.add_argument("--quick", action="store_true", help="one call of each: a test, not a result")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows as JSON")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw belief.png there")
    args = parser.parse_args()
    if args.quick:
        args.rounds = args.calls = 1
    torch.set_num_threads(1)
    rows = [compare(case, args.rounds, args.calls, args.seed) for case in CASES]
    print(f"{'':22s}{'library':>10s}{'bare':>10s}{'ratio':>8s}{'library':>11s}{'bare':>10s}{'ratio':>8s}")
    for row in rows:
        print(
            f"{row['case']:22s}{row['library_ms']:7.2f} ms{row['bare_ms']:7.2f} ms{row['time_ratio']:8.2f}"
            f"{row['library_bytes'] / 1e6:8.2f} MB{row['bare_bytes'] / 1e6:7.2f} MB{row['memory_ratio']:8.2f}"
        )
    growth = [
        grow(case, name, *bounds, rounds=args.rounds, seed=args.seed)
        for case, sizes in GROWTH.items()
        for name, bounds in sizes.items()
    ]
    print(f"\n{'growth':22s}{'in':12s}{'from':>6s}{'to':>6s}{'time':>8s}{'memory':>8s}   (exponents)")
    for row in growth:
        print(
            f"{row['case']:22s}{row['size']:12s}{row['low']:6d}{row['high']:6d}"
            f"{row['time_exponent']:8.2f}{row['memory_exponent']:8.2f}"
        )
    chunks = [chunk(size, args.seed) for size in (None, 1024, 256, 64)]
    print(f"\n{'chunk_size':>10s}{'rollout':>12s}{'its result':>12s}{'filter step':>13s}   (peak MB)")
    for row in chunks:
        print(
            f"{row['chunk_size'] or 'all':>10}{row['rollout_bytes'] / 1e6:12.2f}"
            f"{row['rollout_result_bytes'] / 1e6:12.2f}{row['filter_bytes'] / 1e6:13.2f}"
        )
    if args.out:
        draw(rows, chunks, args.out)
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        settings = {"rounds": args.rounds, "calls": args.calls, "seed": args.seed}
        result = {"settings": settings, "sizes": SIZES, "rows": rows, "growth": growth, "chunks": chunks}
        args.json.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
