"""What every prior must do: batches, tasks along time, casts, copies, vmap, gradients, bad input."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torchrl_vjepa import (
    Ball,
    EnergyPrior,
    GaussianPrior,
    GoalPrior,
    Prior,
    ProbedPrior,
    ProductPrior,
    RegionPrior,
    SlownessPrior,
    SparsityPrior,
    TimeIndexedPrior,
    trajectory_prior,
)

D, P = 3, 2
MATRIX = torch.tensor([[1.0, 0.5, 0.0], [0.0, 1.0, -0.3]])


def pull(latent: Tensor, task: Tensor) -> Tensor:
    return (latent - task).square().sum(-1)


def size(latent: Tensor) -> Tensor:
    return latent.square().sum(-1)


def sines(task: Tensor) -> Tensor:
    return torch.cat([task, task[..., :1].sin()], -1)


class Case(NamedTuple):
    make: Callable[[], Prior]
    task_shape: tuple[int, ...] | None  # None: takes no task; () with dim: the time


def at_goal() -> GoalPrior:
    return GoalPrior(std=0.5, task_key="goal")


def wall(task_key: str | None = None) -> RegionPrior:
    return RegionPrior(Ball(torch.zeros(D), 1.0), "out", sharpness=2.0, task_key=task_key)


def cases() -> dict[str, Case]:
    return {
        "gaussian": Case(lambda: GaussianPrior(D), None),
        "goal": Case(lambda: GoalPrior(std=0.5, latent_dim=D, task_key="goal"), (D,)),
        "mapped goal": Case(lambda: GoalPrior(nn.Linear(2, D), std=0.5, task_key="goal"), (2,)),
        "function goal": Case(lambda: GoalPrior(sines, std=torch.ones(D), task_key="goal"), (2,)),
        "image goal": Case(
            lambda: GoalPrior(
                nn.Sequential(nn.Flatten(-2), nn.Linear(4, D)), std=0.5, task_ndim=2, task_key="goal"
            ),
            (2, 2),
        ),
        "energy": Case(lambda: EnergyPrior(size, latent_dim=D), None),
        "task energy": Case(lambda: EnergyPrior(pull, task_key="goal", latent_dim=D), (D,)),
        "region": Case(wall, None),
        "moving region": Case(lambda: wall(task_key="goal"), (D,)),
        "sparsity": Case(lambda: SparsityPrior(D), None),
        "student": Case(lambda: SparsityPrior(D, degrees=3.0), None),
        "slowness": Case(lambda: SlownessPrior(D, 0.5, task_key="goal"), (D,)),
        "probed": Case(lambda: ProbedPrior(at_goal(), MATRIX), (P,)),
        "square probe": Case(lambda: ProbedPrior(at_goal(), torch.eye(D) + 0.1), (D,)),
        "probed sparsity": Case(lambda: ProbedPrior(SparsityPrior(P), MATRIX), None),
        "product": Case(lambda: ProductPrior(at_goal(), wall(), weights=(2.0, 1.0)), (D,)),
        "gaussian product": Case(
            lambda: ProductPrior(ProbedPrior(at_goal(), MATRIX), GaussianPrior(D)),
            (P,),
        ),
        "nested": Case(
            lambda: ProductPrior(ProductPrior(at_goal(), SparsityPrior(D)), GaussianPrior(D)),
            (D,),
        ),
    }


CASES = cases()
EVERY = pytest.mark.parametrize("name", CASES)
WITH_TASK = pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.task_shape])


def task_of(name: str, *batch: int, dtype: torch.dtype = torch.float32) -> Tensor | None:
    shape = CASES[name].task_shape
    return None if shape is None else torch.randn(*batch, *shape, dtype=dtype)


@EVERY
def test_batches_broadcast_with_rows_of_their_own(name: str) -> None:
    prior = CASES[name].make()
    latent, task = torch.randn(6, 5, D), task_of(name, 5)
    together = prior.log_prob(latent, task)
    assert together.shape == (6, 5)
    assert torch.equal(prior.energy(latent, task), -together)
    for b in range(5):
        alone = prior.log_prob(latent[:, b], None if task is None else task[b])
        torch.testing.assert_close(together[:, b], alone, rtol=1e-4, atol=1e-4)
    assert prior.log_prob(latent[0, 0], task_of(name)).shape == ()


@WITH_TASK
def test_a_task_comes_from_its_entry(name: str) -> None:
    prior = CASES[name].make()
    latent, task = torch.randn(5, D), task_of(name, 5)
    assert isinstance(task, Tensor)
    assert prior.in_keys == ["goal"]
    expected = prior.log_prob(latent, task)
    assert torch.equal(prior.log_prob(latent, {"goal": task}), expected)
    assert torch.equal(prior.log_prob(latent, TensorDict(goal=task, other=latent, batch_size=5)), expected)
    with pytest.raises(ValueError, match="task must be given to"):
        prior.log_prob(latent)
    with pytest.raises(KeyError, match="goal"):
        prior.log_prob(latent, {"other": task})


@WITH_TASK
def test_tasks_along_time(name: str) -> None:
    """Constant and time-indexed ones; the horizon is the last batch dimension."""
    prior = CASES[name].make()
    latent = torch.randn(2, 5, 4, D)
    constant, moving = task_of(name, 5), task_of(name, 5, 7)
    assert isinstance(constant, Tensor)
    assert isinstance(moving, Tensor)
    got = prior.log_prob(latent, prior.along({"goal": constant}, 1, 4))
    torch.testing.assert_close(got, prior.log_prob(latent, constant.unsqueeze(1)), rtol=1e-4, atol=1e-4)
    got = prior.log_prob(latent, prior.along({"goal": moving}, 1, 4))
    for h in range(4):
        expected = prior.log_prob(latent[:, :, h], moving[:, h])
        torch.testing.assert_close(got[:, :, h], expected, rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match="must hold the tasks of at least 8 steps, got 7"):
        prior.along({"goal": moving}, 1, 8)
    with pytest.raises(KeyError, match="goal"):
        prior.along({}, 1, 4)


@WITH_TASK
def test_tasks_that_are_a_function_of_time(name: str) -> None:
    inner = CASES[name].make()
    tasks = task_of(name, 6)
    assert isinstance(tasks, Tensor)
    prior = TimeIndexedPrior(inner, tasks)
    latent = torch.randn(2, 4, D)
    times = prior.along({"step_count": torch.tensor([[0], [3]])}, 1, 4)
    got = prior.log_prob(latent, times)
    for b, start in enumerate((0, 3)):
        for h in range(4):
            expected = inner.log_prob(latent[b, h], tasks[min(start + 1 + h, 5)])
            torch.testing.assert_close(got[b, h], expected, rtol=1e-4, atol=1e-4)


@EVERY
def test_a_bound_prior_takes_none(name: str) -> None:
    prior = CASES[name].make()
    latent, task = torch.randn(5, D), task_of(name, 5)
    for given in (task, None if task is None else {"goal": task, "other": latent}):
        bound = prior.bind(given)
        assert bound.in_keys == []
        assert bound.along({}, 1, 3) == {}
        assert torch.equal(bound.log_prob(latent), prior.log_prob(latent, task))
        twin = pickle.loads(pickle.dumps(bound.double()))
        assert twin.log_prob(latent.double()).dtype == torch.float64
        prior = prior.float()
    if task is not None:
        with pytest.raises(ValueError, match="task must be finite, got"):
            prior.bind(torch.full_like(task, math.nan))
        with pytest.raises(KeyError, match="goal"):
            prior.bind({})


@EVERY
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_casts_copies_vmap_and_gradients(name: str, dtype: torch.dtype) -> None:
    prior = CASES[name].make().to(dtype)
    task = task_of(name, dtype=dtype)
    latent = torch.randn(7, 4, D, dtype=dtype, requires_grad=True)
    value = prior.log_prob(latent, task)
    assert value.dtype == dtype
    slope = torch.autograd.grad(value.sum(), latent)[0]
    assert slope.isfinite().all()
    assert slope.any(-1).all()
    mapped = torch.func.vmap(lambda z: prior.log_prob(z, task))(latent)
    torch.testing.assert_close(mapped, value, rtol=1e-4, atol=1e-4)
    rows = None if task is None else task.expand(7, *task.shape)
    if task is not None:
        mapped = torch.func.vmap(prior.log_prob)(latent, rows)
        torch.testing.assert_close(mapped, value, rtol=1e-4, atol=1e-4)
    for twin in (copy.deepcopy(prior), pickle.loads(pickle.dumps(prior))):
        assert torch.equal(twin.log_prob(latent, task), value)
    if dtype == torch.float64 and name != "moving region":
        torch.autograd.gradcheck(lambda z: prior.log_prob(z, task), latent[0, :2].detach().requires_grad_())


@EVERY
@pytest.mark.parametrize("wrong", [1, D + 1])
def test_a_latent_of_another_size_is_refused(name: str, wrong: int) -> None:
    prior = CASES[name].make()
    with pytest.raises(ValueError, match=f"latent must have last dimension {D}"):
        prior.log_prob(torch.zeros(5, wrong), task_of(name))


@EVERY
def test_nothing_is_learned_by_default(name: str) -> None:
    assert not [p for p in CASES[name].make().parameters() if p.requires_grad]


# --- time


def test_trajectory_prior_is_a_quadratic_well() -> None:
    path, std = torch.randn(5, D), torch.tensor([0.1, 1.0, 2.0])
    prior = trajectory_prior(path, std)
    latent, time = torch.randn(6, D), torch.tensor([[0], [1], [2], [4], [5], [99]])
    expected = 0.5 * ((latent - path[[0, 1, 2, 4, 4, 4]]) / std).square().sum(-1)
    got = prior.energy(latent, time)
    torch.testing.assert_close(got - got[0], expected - expected[0], rtol=1e-4, atol=1e-4)


def test_periodic_times() -> None:
    prior = trajectory_prior(torch.arange(4.0).unsqueeze(-1), 1.0, periodic=True)
    time = torch.tensor([[0], [3], [4], [9], [-1]])
    assert prior(time).mean.squeeze(-1).tolist() == [0, 3, 0, 1, 3]
    assert trajectory_prior(torch.arange(4.0).unsqueeze(-1), 1.0)(time).mean.squeeze(-1).tolist() == [
        *(0, 3, 3, 3, 0)
    ]


def test_times_that_are_given_step_by_step() -> None:
    prior = trajectory_prior(torch.randn(9, 1), 1.0, time_key=("agent", "t"))
    times = torch.tensor([[[7], [2], [5]]])
    assert torch.equal(prior.along({("agent", "t"): times}, 1, 2)["agent", "t"], times[:, :2])


def test_bad_times_and_tasks_are_refused() -> None:
    prior = trajectory_prior(torch.zeros(3, 1), 1.0)
    for bad in (torch.tensor([1.0]), torch.tensor([1, 2]), torch.tensor(1), torch.tensor([True])):
        with pytest.raises(ValueError, match=r"task must be the time, integers of shape \(\*B, 1\)"):
            prior(bad)
    with pytest.raises(ValueError, match=r"path must have shape \(T, D\), got \(3,\)"):
        trajectory_prior(torch.zeros(3), 1.0)
    for tasks in (torch.zeros(3), torch.zeros(0, D), torch.full((3, D), math.nan)):
        with pytest.raises(ValueError, match="tasks must be finite with shape"):
            TimeIndexedPrior(GoalPrior(std=1.0), tasks)
    with pytest.raises(ValueError, match=r"prior must take one task, got in_keys=\[\]"):
        TimeIndexedPrior(GaussianPrior(D), torch.zeros(3, D))


# --- energies


@pytest.mark.parametrize(
    ("energy", "message"),
    [
        (lambda z: z, "energy must return a tensor of shape"),
        (lambda z: z.sum(), "energy must return a tensor of shape"),
        (lambda z: z[..., :1], "energy must return a tensor of shape"),
        (lambda z: z.sum(-1).mean(0, keepdim=True), "energy must return a tensor of shape"),
        (lambda z: 1.0, "energy must return a tensor of shape .* got float"),
        (lambda z: z.sum(-1).log(), "energy must be finite, got NaN"),
        (lambda z: size(z.detach()), "energy must have a gradient"),
        (lambda z: torch.zeros(z.shape[:-1], requires_grad=True) * 1.0, "energy must have a gradient"),
        (lambda z: (0.0 * z).abs().sqrt().sum(-1), "energy must have a finite gradient"),
    ],
)
def test_bad_energies_are_refused(energy: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        EnergyPrior(energy, latent_dim=D)
    with pytest.raises(ValueError, match=message):
        EnergyPrior(lambda z, task: energy(z), task_key="goal", latent_dim=D).bind(torch.zeros(2))
    EnergyPrior(energy)  # nothing is known of the latent yet


def test_energies_without_a_gradient() -> None:
    prior = EnergyPrior(lambda z: (z > 0).all(-1).float(), latent_dim=D, differentiable=False)
    assert not prior.differentiable
    assert not ProductPrior(prior, GaussianPrior(D)).differentiable
    assert ProductPrior(prior, GaussianPrior(D), weights=(0, 1)).differentiable
    assert not prior.bind(None).differentiable
    assert prior.energy(torch.ones(4, D)).tolist() == [1.0] * 4


def test_weights_of_energies() -> None:
    latent = torch.randn(4, D)
    torch.testing.assert_close(EnergyPrior(size, weight=2.5).energy(latent), 2.5 * size(latent))
    assert EnergyPrior(size, weight=0.0)().is_flat
    for weight in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="weight must be finite and at least 0"):
            EnergyPrior(size, weight=weight)
    with pytest.raises(TypeError, match="energy must be callable, got Tensor"):
        EnergyPrior(torch.zeros(1))  # type: ignore[arg-type]


def test_a_modules_parameters_are_the_priors() -> None:
    net = nn.Sequential(nn.Linear(D, 1), nn.Flatten(-2)).double()
    prior = EnergyPrior(lambda z: net(z.unsqueeze(-2)).squeeze(-1))
    assert not list(prior.parameters())
    learned = EnergyPrior(nn.Bilinear(D, D, 1))
    assert len(list(learned.parameters())) == 2


def test_the_trial_works_without_gradients_around() -> None:
    with torch.no_grad():
        EnergyPrior(size, latent_dim=D)
    with torch.inference_mode():
        EnergyPrior(size, latent_dim=D)


def test_a_task_that_is_needed_cannot_be_bound_to_nothing() -> None:
    with pytest.raises(KeyError, match=r"task must hold the entries \['goal'\], got None"):
        at_goal().bind(None)
    assert GaussianPrior(D).bind(None).in_keys == []
