"""What every planner promises, over random specifications, shapes, dtypes and costs."""

from __future__ import annotations

import copy
import math
import warnings
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from specs import specs
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import Binary, Bounded, Categorical, Composite, MultiCategorical, OneHot, TensorSpec

from _memory import peak
from torchrl_vjepa.distributions import Delta, diag_gaussian
from torchrl_vjepa.envs import LatentEnv
from torchrl_vjepa.planners import (
    CEM,
    MPPI,
    ExhaustiveSearch,
    GradientMPC,
    Planner,
    RandomShooting,
    SamplingPlanner,
    TreeSearch,
)

SAMPLING = [RandomShooting, CEM, MPPI]
TREES = [ExhaustiveSearch, TreeSearch]
planners = st.sampled_from(SAMPLING)


def few_choices() -> st.SearchStrategy[TensorSpec]:
    """Specifications of which a tree has few branches."""
    leaf = st.sampled_from([OneHot(3), Categorical(2), MultiCategorical([2, 3]), Binary(2), Categorical(1)])
    return st.one_of(leaf, st.builds(lambda a, b: Composite(left=a, deep=Composite(right=b)), leaf, leaf))


def families() -> st.SearchStrategy[tuple[type[Planner], TensorSpec]]:
    """Every planner with a specification that it takes."""
    return st.one_of(
        st.tuples(planners, specs()),
        st.tuples(planners, specs()),
        st.tuples(st.sampled_from(TREES), few_choices()),
    )


#: What changes how candidates are drawn, held and remembered.
options = st.fixed_dictionaries(
    {
        "noise_beta": st.sampled_from([0.0, 2.0]),
        "keep_elites": st.sampled_from([0.0, 0.5]),
        "carry_elites": st.sampled_from([0.0, 0.5]),
        "population_decay": st.sampled_from([1.0, 0.5]),
        "action_repeat": st.sampled_from([1, 2]),
    }
)


def drift(latent: Tensor, action: Tensor) -> Delta:
    return Delta(0.9 * latent + 0.1 * action.sum(-1, keepdim=True).tanh())


def drift_with_noise(latent: Tensor, action: Tensor) -> torch.distributions.Distribution:
    loc = drift(latent, action).mean
    return diag_gaussian(loc, torch.full_like(loc, 0.1))


class Grid:
    """A cost without structure, in multiples of 1/64: sums, shifts and doublings of it are exact."""

    def __init__(self, scale: float = 1.0, shift: float = 0.0) -> None:
        self.scale, self.shift = scale, shift

    def __call__(self, latent: Tensor, action: Tensor) -> Tensor:
        weights = torch.linspace(1.0, 2.0, action.shape[-1], dtype=action.dtype)
        value = 3 * (5 * latent[..., 0]).sin() + ((action - 0.3) * weights).sin().sum(-1)
        return self.scale * ((64 * value).round() / 64) + self.shift


class Spoilt:
    """The cost, with a value that is no number of use where the action says so; or everywhere."""

    def __init__(self, value: float, everywhere: bool) -> None:
        self.value, self.everywhere = value, everywhere

    def __call__(self, latent: Tensor, action: Tensor) -> Tensor:
        cost = Grid()(latent, action)
        spoilt = torch.ones_like(cost).bool() if self.everywhere else cost > 0
        return torch.where(spoilt, self.value, cost)


class Distance:
    """To one code: its only optimum."""

    def __init__(self, target: Tensor) -> None:
        self.target = target

    def __call__(self, latent: Tensor, action: Tensor) -> Tensor:
        return (action - self.target.to(action.dtype)).square().sum(-1)


def make_planner(
    cls: type[Planner], spec: TensorSpec, cost: Any = None, *, model: Any = drift, **kwargs: Any
) -> Planner:
    how = {} if model is drift else {"how": "sample", "num_samples": 3}
    env = LatentEnv(
        model,
        action_spec=spec,
        cost=Grid() if cost is None else cost,
        latent_dim=1,
        dtype=torch.float64,
        **how,
    )
    horizon = kwargs.pop("horizon", 2)
    settings = {"optim_steps": 3, "num_candidates": 12, "top_k": 4, "init_std": 0.5}
    if not issubclass(cls, SamplingPlanner):
        settings = {"num_simulations": 12} if cls is TreeSearch else {"warm_start": True}
        kwargs = {name: kwargs[name] for name in ("action_repeat", "return_stats") if name in kwargs}
    return cls(env, horizon, **{**settings, "seed": 0, **kwargs})


def is_sampled(cls: type[Planner], sampled: bool) -> bool:
    return sampled and cls is not TreeSearch


def states(*batch: int, seed: int = 0) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    latent = 2 * torch.randn(*batch, 1, generator=generator, dtype=torch.float64)
    return TensorDict(latent=latent, batch_size=batch)


def full(spec: TensorSpec) -> Composite:
    return spec if isinstance(spec, Composite) else Composite(action=spec)


def actions(planner: Planner, td: TensorDict) -> TensorDict:
    return td.select(*planner.codec.keys)


def assert_same(one: TensorDict, two: TensorDict) -> None:
    for key, value in one.items(True, True):
        torch.testing.assert_close(value, two[key])


@settings(max_examples=80)
@given(
    family=families(),
    value=st.sampled_from([math.nan, math.inf, -math.inf, 1e30, -1e30, 0.0, 1e308]),
    everywhere=st.booleans(),
    batch=st.sampled_from([(), (3,), (2, 1), (0,)]),
    decisions=st.integers(1, 3),
    num=st.integers(3, 9),
    output=st.sampled_from(["mean", "best"]),
    sampled=st.booleans(),
    given=options,
)
def test_actions_are_finite_and_inside_whatever_the_cost_returns(
    family: tuple[type[Planner], TensorSpec],
    value: float,
    everywhere: bool,
    batch: tuple[int, ...],
    decisions: int,
    num: int,
    output: str,
    sampled: bool,
    given: dict[str, Any],
) -> None:
    cls, spec = family
    kwargs = {} if cls is RandomShooting else {"output": output}
    model = drift_with_noise if is_sampled(cls, sampled) else drift
    cost = Spoilt(value, everywhere)
    # Statistics of a tree are those of a search in every step.
    stats = not (cls is TreeSearch and given["action_repeat"] > 1)
    sizes = {"horizon": decisions * given["action_repeat"], "num_candidates": num, "top_k": max(1, num // 2)}
    planner = make_planner(cls, spec, cost, model=model, return_stats=stats, **sizes, **given, **kwargs)
    td = states(*batch)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        for _ in range(2):
            planner(td)
            if 0 in batch:
                continue
            for row in actions(planner, td).reshape(-1):
                assert full(spec).is_in(row)
            codes = planner.codec.size
            if stats:
                assert td["plan_stats", "std"].isfinite().all()
            plans = [("plan_stats", "actions")] * stats
            for key in [
                *plans,
                *(("next", key) for part, key in planner.memory.keys.items() if part != "age"),
            ]:
                rows = td[key].reshape(-1, codes)
                assert rows.isfinite().all()
                for row in planner.codec.decode(rows):
                    assert full(spec).is_in(row)
            td.update(td["next"])


@settings(max_examples=40)
@given(family=families(), sampled=st.booleans(), split=st.integers(1, 15), given=options)
def test_any_split_of_a_batch_gives_the_same_plans(
    family: tuple[type[Planner], TensorSpec], sampled: bool, split: int, given: dict[str, Any]
) -> None:
    cls, spec = family
    model = drift_with_noise if is_sampled(cls, sampled) else drift
    planner = make_planner(cls, spec, model=model, num_candidates=20, **given)
    td = states(16)
    td = states(16, seed=1).update(planner(td)["next"])
    planner.set_seed(0)
    together = planner(td.clone())
    parts = []
    for part in td.split([split, 16 - split]):
        planner.set_seed(0)
        parts.append(planner(part.clone()))
    for key in planner.out_keys:
        torch.testing.assert_close(torch.cat([part[key] for part in parts]), together[key])
    for row in range(16):
        planner.set_seed(0)
        alone = planner(td[row].clone())
        assert_same(actions(planner, alone), actions(planner, together[row]))


@settings(max_examples=30)
@given(family=families(), order=st.permutations(range(6)), given=options)
def test_permuting_environments_permutes_plans(
    family: tuple[type[Planner], TensorSpec], order: list[int], given: dict[str, Any]
) -> None:
    planner = make_planner(*family, **given)
    td = states(6, seed=1).update(planner(states(6))["next"])
    planner.set_seed(0)
    expected = planner(td.clone())
    planner.set_seed(0)
    permuted = planner(td[order])
    for key in planner.out_keys:
        torch.testing.assert_close(permuted[key], expected[key][order])


@settings(max_examples=30)
@given(cls=planners, spec=specs(), num=st.integers(3, 9), sampled=st.booleans(), given=options)
def test_more_rounds_never_worsen_the_best_plan(
    cls: type[Planner], spec: TensorSpec, num: int, sampled: bool, given: dict[str, Any]
) -> None:
    model = drift_with_noise if sampled else drift
    last = torch.full((5,), math.inf, dtype=torch.float64)
    sizes = {"num_candidates": num, "top_k": 1}
    for steps in range(1, 6):
        planner = make_planner(cls, spec, model=model, optim_steps=steps, **sizes, **given)
        start = planner.family.cold((5,), planner.num_decisions)
        found = planner.plan(states(5)["latent"], start)
        assert (found.best_cost <= last).all()
        last = found.best_cost


@settings(max_examples=30)
@given(spec=specs(), power=st.integers(-20, 20), shift=st.integers(-1000, 1000))
def test_scale_and_shift_of_the_cost_do_not_change_cem(spec: TensorSpec, power: int, shift: int) -> None:
    one = make_planner(CEM, spec)(states(4))
    two = make_planner(CEM, spec, Grid(2.0**power, 2.0**power * shift))(states(4))
    for key in make_planner(CEM, spec).out_keys:
        assert torch.equal(one[key], two[key])


@pytest.mark.parametrize("cls", [CEM, MPPI, GradientMPC])
def test_large_costs_keep_their_differences(cls: type[Planner]) -> None:
    """Of a model in float64 with actions in float32: costs are in the dtype that they are computed in."""

    def distance(latent: Tensor, action: Tensor) -> Tensor:
        return (latent[..., 0] - 0.02).square() + 1e9

    env = LatentEnv(drift, action_spec=Bounded(-1, 1, (1,)), cost=distance, latent_dim=1, dtype=torch.float64)
    td = TensorDict(latent=torch.zeros(1, dtype=torch.float64))
    action = cls(env, 1, seed=0)(td)["action"]
    torch.testing.assert_close(action, torch.tensor([0.2027]), atol=0.05, rtol=0)
    assert action.dtype == torch.float32


@settings(max_examples=30)
@given(spec=specs(), power=st.integers(-20, 20), shift=st.integers(-1000, 1000))
def test_they_change_mppi_through_its_temperature_alone(spec: TensorSpec, power: int, shift: int) -> None:
    scale = 2.0**power
    cost = Grid(scale, scale * shift)
    for one, two in (
        ({"temperature": 0.5}, {"temperature": 0.5}),
        (
            {"temperature": 0.5, "normalize_costs": False},
            {"temperature": 0.5 * scale, "normalize_costs": False},
        ),
    ):
        planner = make_planner(MPPI, spec, **one, num_candidates=20)
        expected = planner(states(4))
        actual = make_planner(MPPI, spec, cost, **two, num_candidates=20)(states(4))
        assert_same(actions(planner, expected), actions(planner, actual))


@settings(max_examples=30)
@given(family=families(), row=st.integers(0, 4), given=options)
def test_the_reset_of_one_row_changes_no_other(
    family: tuple[type[Planner], TensorSpec], row: int, given: dict[str, Any]
) -> None:
    planner = make_planner(*family, **given)
    td = states(5, seed=1).update(planner(states(5))["next"])
    td["is_init"] = torch.zeros(5, 1).bool()
    state = planner.generator.get_state(), planner._model_generator.get_state()
    running = planner(td.clone())
    planner.generator.set_state(state[0])
    planner._model_generator.set_state(state[1])
    td["is_init"][row] = True
    reset = planner(td.clone())
    others = [k for k in range(5) if k != row]
    for key in planner.out_keys:
        torch.testing.assert_close(reset[key][others], running[key][others])
    planner.generator.set_state(state[0])
    planner._model_generator.set_state(state[1])
    new = planner(td.select("latent"))
    for key in planner.out_keys:
        torch.testing.assert_close(reset[key][row], new[key][row])


@settings(max_examples=40)
@given(cls=planners, spec=specs(), data=st.data())
def test_a_warm_start_from_a_perfect_plan_keeps_it(cls: type[Planner], spec: TensorSpec, data: Any) -> None:
    torch.manual_seed(data.draw(st.integers(0, 99)))
    kwargs = {} if cls is RandomShooting else {"output": "best"}
    codec = make_planner(cls, spec).codec
    perfect = codec.decode(torch.randn(codec.size, dtype=codec.dtype))
    code = codec.encode(perfect)
    planner = make_planner(cls, spec, Distance(code), **kwargs)
    plan = code.expand(3, 2, -1).reshape(3, 2, *codec.shape)
    td = states(3).set("plan", plan).set("is_init", torch.zeros(3, 1).bool())
    for _ in range(3):
        out = planner(td.clone())
        assert_same(actions(planner, out), perfect.expand(3))
        torch.testing.assert_close(out["next", "plan"], plan.to(out["next", "plan"].dtype))
        td["plan"] = out["next", "plan"]


@settings(max_examples=25)
@given(
    cls=planners,
    spec=specs(),
    num=st.integers(20, 300),
    chunk=st.integers(2, 20),
    batch=st.integers(1, 4),
    sampled=st.booleans(),
)
def test_memory_stays_under_its_bound(
    cls: type[Planner], spec: TensorSpec, num: int, chunk: int, batch: int, sampled: bool
) -> None:
    """As ``chunk_size`` says: that of a plan of so many candidates, and ten times the candidates."""
    model = drift_with_noise if sampled else drift
    given = {"model": model, "horizon": 5, "top_k": 2}
    bounded = make_planner(cls, spec, num_candidates=num, chunk_size=chunk, **given)
    small = make_planner(cls, spec, num_candidates=chunk, **given)
    codec = bounded.codec
    candidates = batch * num * 5 * codec.size * codec.dtype.itemsize
    td = states(batch)
    assert peak(lambda: bounded(td.clone())) <= peak(lambda: small(td.clone())) + 10 * candidates


class Network(nn.Module):
    """With everything that a careless call would change."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(1 + size, 8), nn.BatchNorm1d(8), nn.Dropout(), nn.Linear(8, 1))

    def forward(self, latent: Tensor, action: Tensor) -> Delta:
        rows = torch.cat([latent, action], dim=-1)
        return Delta(self.layers(rows.flatten(0, -2)).reshape(latent.shape))


@pytest.mark.parametrize(
    ("cls", "spec"),
    [
        *((cls, Bounded(-1, 1, (2,))) for cls in (*SAMPLING, GradientMPC)),
        *((cls, Categorical(2)) for cls in (*SAMPLING, *TREES)),
    ],
)
@pytest.mark.parametrize("training", [False, True])
def test_planners_touch_nothing(cls: type[Planner], spec: TensorSpec, training: bool) -> None:
    model = Network(2)
    env = LatentEnv(model, action_spec=spec, cost=Grid(), latent_dim=1)
    model.layers.train(training)
    model.layers[1].eval()  # statistics in training mode are the model's own affair
    model.layers[2].eval()  # and so is the global random state behind a dropout
    model.layers[0].weight.grad = torch.full_like(model.layers[0].weight, 3.0)
    steps = {} if cls in TREES else {"optim_steps": 2}
    planner = cls(env, 3, **steps, seed=0, return_stats=True)
    before = copy.deepcopy(dict(model.named_parameters())), copy.deepcopy(dict(model.named_buffers()))
    modes = [module.training for module in planner.modules()]
    random = torch.get_rng_state()
    td = states(4).float()
    planner(td)
    assert torch.equal(random, torch.get_rng_state())
    assert torch.is_grad_enabled()
    assert modes == [module.training for module in planner.modules()]
    for name, parameter in model.named_parameters():
        assert torch.equal(parameter, before[0][name])
        assert parameter.requires_grad
    assert all(torch.equal(buffer, before[1][name]) for name, buffer in model.named_buffers())
    grads = [parameter.grad for parameter in model.parameters()]
    assert (grads[0] == 3.0).all()
    assert grads[1:] == [None] * (len(grads) - 1)
    assert not any(value.requires_grad for value in td.values(True, True))
