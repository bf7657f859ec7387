"""ProductPrior and ProbedPrior against sums of log-densities, integrals, and the Kalman filter."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.distributions import Distribution, Independent, LowRankMultivariateNormal, MultivariateNormal

from torchrl_vjepa import (
    Ball,
    Density,
    EnergyPrior,
    GaussianFactor,
    GaussianPrior,
    GoalPrior,
    LinearProbe,
    LowRankGaussian,
    Mixture,
    Prior,
    ProbedPrior,
    ProductPrior,
    RegionPrior,
    SparsityPrior,
    TimeIndexedPrior,
    diag_gaussian,
)

D = 3
DTYPE = torch.float64
SEEDS = st.integers(0, 10**6)


class Given(Prior):
    """A prior whose density is given."""

    def __init__(self, density: Any, latent_dim: int | None = D) -> None:
        super().__init__(latent_dim=latent_dim)
        self.density = density

    def forward(self, task: Any = None) -> Any:
        return self.density


def density(kind: str, generator: torch.Generator) -> Any:
    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=DTYPE)

    mean, scale = randn(2, D), randn(D).abs() + 0.3
    if kind == "diagonal":
        return diag_gaussian(mean, scale)
    if kind == "full":
        root = randn(D, D)
        return MultivariateNormal(mean, root @ root.mT + 0.5 * torch.eye(D, dtype=DTYPE))
    if kind == "low rank":
        return LowRankGaussian(mean, randn(D, 1), scale)
    if kind == "torch low rank":
        return LowRankMultivariateNormal(mean, randn(D, 1), scale)
    if kind == "factor":
        row = randn(1, D)
        return GaussianFactor(row.mT @ row, 2.0 * row.squeeze(0), 0.3)
    if kind == "mixture":
        return Mixture(randn(2, 2), diag_gaussian(randn(2, 2, D), scale))
    if kind == "laplace":
        return SparsityPrior(D, scale=scale).double()()
    if kind == "energy":
        return Density(lambda z: z.abs().sum(-1))
    if kind == "energy and base":
        return Density(lambda z: z.abs().sum(-1), diag_gaussian(mean, scale))
    return Density()


GAUSSIAN = ["diagonal", "full", "low rank", "torch low rank"]
KINDS = [*GAUSSIAN, "factor", "mixture", "laplace", "energy", "energy and base", "flat"]


def differences(values: Tensor) -> Tensor:
    """Log-densities without their constants."""
    return values - values[:1]


@settings(max_examples=80, deadline=None)
@given(
    seed=SEEDS,
    kinds=st.lists(st.sampled_from(KINDS), min_size=1, max_size=4),
    weights=st.lists(st.sampled_from([0.0, 0.5, 1.0, 3.0]), min_size=4, max_size=4),
)
def test_product_is_the_weighted_sum_of_log_densities(
    seed: int, kinds: list[str], weights: list[float]
) -> None:
    generator = torch.Generator().manual_seed(seed)
    experts = [density(kind, generator) for kind in kinds]
    weights = weights[: len(kinds)]
    product = ProductPrior(*map(Given, experts), weights=weights)()
    z = torch.randn(7, 2, D, generator=generator, dtype=DTYPE)
    expected = torch.zeros(7, 2, dtype=DTYPE)
    for p, weight in zip(experts, weights, strict=True):
        expected = expected + weight * p.log_prob(z)
    got = product.log_prob(z).expand(7, 2)
    torch.testing.assert_close(differences(got), differences(expected), rtol=1e-6, atol=1e-6)
    active = [kind for kind, weight in zip(kinds, weights, strict=True) if weight]
    if active and set(active) <= {*GAUSSIAN, "factor"} and set(active) & set(GAUSSIAN):
        assert isinstance(product, Distribution)  # the closed form
    if set(active) <= {"flat"}:
        assert isinstance(product, Density)
        assert product.is_flat


def test_closed_forms_are_kept() -> None:
    generator = torch.Generator().manual_seed(0)
    kinds = {kind: Given(density(kind, generator)) for kind in KINDS}
    made = lambda *names, **kwargs: ProductPrior(*(kinds[n] for n in names), **kwargs)()  # noqa: E731
    assert isinstance(made("diagonal", "diagonal", weights=(2, 0.5)), Independent)
    assert isinstance(made("factor", "factor"), GaussianFactor)
    assert isinstance(made("mixture", "diagonal"), Mixture)
    assert isinstance(made("mixture", "factor", "full"), Mixture)
    assert isinstance(made("mixture", "factor"), Density)
    mixed = made("energy", "energy and base", "diagonal")
    assert isinstance(mixed, Density)
    assert isinstance(mixed.base, Independent)


def test_factors_keep_their_constants() -> None:
    generator = torch.Generator().manual_seed(0)
    first, second = density("factor", generator), density("factor", generator)
    z = torch.randn(5, D, generator=generator, dtype=DTYPE)
    got = ProductPrior(Given(first), Given(second), weights=(2, 1)).log_prob(z)
    torch.testing.assert_close(got, 2 * first.log_prob(z) + second.log_prob(z))


def test_one_expert_is_itself_and_none_is_flat() -> None:
    prior = GaussianPrior(D)
    latent = torch.randn(4, D)
    for product in (
        ProductPrior(prior),
        ProductPrior(prior, SparsityPrior(D), weights=(1, 0)),
        ProductPrior(ProductPrior(ProductPrior(), prior)),
    ):
        assert torch.equal(product.log_prob(latent), prior.log_prob(latent))
    assert ProductPrior()().is_flat  # type: ignore[union-attr]
    assert ProductPrior(prior, weights=(0,))().is_flat  # type: ignore[union-attr]
    assert not ProductPrior().log_prob(latent).any()
    # What is dropped reads nothing.
    assert ProductPrior(prior, GoalPrior(std=1.0), weights=(1, 0)).in_keys == []


def test_every_expert_takes_its_own_task() -> None:
    wall = RegionPrior(Ball(torch.zeros(D), 1.0), "out", sharpness=2.0, task_key=("map", "obstacle"))
    path = TimeIndexedPrior(GoalPrior(std=0.2), torch.randn(9, D))
    prior = ProductPrior(ProductPrior(wall, GoalPrior(std=0.5)), path, GoalPrior(std=2.0))
    assert prior.in_keys == [("map", "obstacle"), "task", "step_count"]
    assert prior.task_key is None
    tasks = {
        ("map", "obstacle"): torch.randn(5, 4, D),
        "task": torch.randn(5, D),
        "step_count": torch.tensor([[0], [1], [2], [3], [4]]),
    }
    along = prior.along(tasks, batch_ndim=1, horizon=4)
    assert {key: value.shape[1] for key, value in along.items()} == {
        ("map", "obstacle"): 4,
        "task": 1,
        "step_count": 4,
    }
    z = torch.randn(7, 5, 4, D)
    expected = (
        wall.log_prob(z, tasks["map", "obstacle"])
        + GoalPrior(std=0.5).log_prob(z, tasks["task"].unsqueeze(1))
        + path.log_prob(z, along["step_count"])
        + GoalPrior(std=2.0).log_prob(z, tasks["task"].unsqueeze(1))
    )
    got = prior.log_prob(z, along)
    torch.testing.assert_close(differences(got), differences(expected), rtol=1e-3, atol=1e-3)
    same = prior.bind({**tasks, ("map", "obstacle"): torch.zeros(D)})
    assert same.log_prob(z[:, :, 0]).shape == (7, 5)


def test_one_entry_read_in_two_ways_is_refused() -> None:
    prior = ProductPrior(trajectory(), GoalPrior(std=1.0, task_key="step_count"))
    with pytest.raises(ValueError, match="read the entry 'step_count' in different ways"):
        prior.along({"step_count": torch.zeros(5, 1, dtype=torch.long)}, 1, 3)


def trajectory() -> Prior:
    return TimeIndexedPrior(GoalPrior(std=1.0), torch.zeros(3, D))


def test_contradictory_experts_compromise_by_precision() -> None:
    far = [GaussianPrior(1, mean=m, std=1e-3) for m in (-100.0, 200.0)]
    p = ProductPrior(*far, weights=(2, 1))()
    assert isinstance(p, Distribution)
    torch.testing.assert_close(p.mean, torch.zeros(1), rtol=0, atol=1e-4)
    torch.testing.assert_close(p.stddev, torch.tensor([1e-3 / math.sqrt(3)]))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ProductPrior(GaussianPrior(2), weights=(1, 2)), "weights must be 1 finite numbers"),
        (lambda: ProductPrior(GaussianPrior(2), weights=(-1,)), "weights must be 1 finite"),
        (lambda: ProductPrior(GaussianPrior(2), weights=(math.nan,)), "weights must be 1 finite"),
        (lambda: ProductPrior(GaussianPrior(2), GaussianPrior(3)), "priors must be of the same latent"),
        (
            lambda: ProductPrior(GaussianPrior(2, std=1e-18), GaussianPrior(2), weights=(1e10, 1)),
            "the experts are too sharp, or contradict each other",
        ),
        (lambda: GaussianPrior(2, std=1e-30), r"std must be in \[.*\], else its precision overflows"),
        (lambda: GoalPrior(std=1e30), r"std must be in \[.*\], else its precision overflows"),
    ],
)
def test_impossible_products_are_refused(build: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build()


# --- probed coordinates


def grid(dim: int, half: float, points: int) -> tuple[Tensor, float]:
    axis = torch.linspace(-half, half, points, dtype=DTYPE)
    cell = float(axis[1] - axis[0]) ** dim
    return torch.stack(torch.meshgrid(*[axis] * dim, indexing="ij"), -1).reshape(-1, dim), cell


@pytest.mark.parametrize("kind", ["gaussian", "full", "laplace", "energy"])
@pytest.mark.parametrize("dim", [1, 2])
def test_a_square_probe_is_the_change_of_variables(kind: str, dim: int) -> None:
    """It integrates to one where the coordinate's density does, and draws of it, mapped, are its own."""
    matrix = torch.tensor([[1.5, 0.4], [-0.3, 2.0]], dtype=DTYPE)[:dim, :dim]
    offset = torch.tensor([0.3, -0.6], dtype=DTYPE)[:dim]
    inner: dict[str, Prior] = {
        "gaussian": GaussianPrior(dim, mean=0.4, std=0.7),
        "full": GaussianPrior(dim, mean=0.4, covariance=torch.eye(dim) + 0.5),
        "laplace": SparsityPrior(dim, scale=0.5),
        "energy": EnergyPrior(lambda y: y.square().sum(-1) + math.log(math.pi) * dim / 2),
    }
    prior = ProbedPrior(inner[kind], matrix, offset).double()
    z, cell = grid(dim, 8.0, 1601 if dim == 1 else 641)
    total = prior.log_prob(z).exp().sum() * cell
    volume = 1.0 if kind != "energy" else torch.linalg.det(matrix).abs().item()
    # The energy of a density that is not normalised is known up to a constant.
    assert total.item() * volume == pytest.approx(1.0, abs=2e-3)
    if kind in ("gaussian", "full"):
        p, q = prior(), inner[kind].double()()
        assert isinstance(p, MultivariateNormal)
        assert isinstance(q, Distribution)
        mapped = matrix @ p.covariance_matrix @ matrix.mT
        torch.testing.assert_close(p.mean @ matrix.mT + offset, q.mean, rtol=1e-6, atol=1e-6)
        want = q.covariance_matrix if kind == "full" else q.variance.diag()
        torch.testing.assert_close(mapped, want, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("kind", ["gaussian", "laplace"])
def test_the_coarea_factor(kind: str) -> None:
    """One coordinate of two: across the fibres, along the unit normal, the density integrates to one."""
    matrix = torch.tensor([[3.0, 4.0]])
    inner = GaussianPrior(1, mean=1.0, std=0.7) if kind == "gaussian" else SparsityPrior(1, scale=0.5)
    prior = ProbedPrior(inner, matrix, 0.5).double()
    along, cell = grid(1, 5.0, 20001)
    normal, fibre = matrix.double() / 5.0, torch.tensor([[-4.0, 3.0]], dtype=DTYPE) / 5.0
    for shift in (0.0, 7.0):
        total = prior.log_prob(along * normal + shift * fibre).exp().sum() * cell
        assert total.item() == pytest.approx(1.0, abs=1e-3)


@settings(max_examples=30, deadline=None)
@given(seed=SEEDS, size=st.integers(1, 3), kind=st.sampled_from(["diagonal", "full"]))
def test_it_is_the_kalman_update_by_a_virtual_measurement(seed: int, size: int, kind: str) -> None:
    generator = torch.Generator().manual_seed(seed)
    matrix = torch.randn(size, 4, generator=generator) + torch.eye(size, 4)
    offset, goal = torch.randn(2, size, generator=generator).unbind()
    root = torch.randn(size, size, generator=generator)
    noise = root @ root.mT + 0.5 * torch.eye(size) if kind == "full" else 0.3 * torch.eye(size)
    inner = GaussianPrior(size, mean=goal, covariance=noise)
    if kind == "diagonal":
        inner = GaussianPrior(size, mean=goal, std=math.sqrt(0.3))
    mean = torch.randn(4, generator=generator)
    spread = torch.randn(4, 4, generator=generator)
    covariance = spread @ spread.mT + 0.5 * torch.eye(4)
    predicted = GaussianPrior(4, mean=mean, covariance=covariance)
    product = ProductPrior(predicted, ProbedPrior(inner, matrix, offset)).double()()
    w, b, y, m, s, r = (x.double() for x in (matrix, offset, goal, mean, covariance, noise))
    gain = s @ w.mT @ torch.linalg.inv(w @ s @ w.mT + r)
    assert isinstance(product, MultivariateNormal)
    torch.testing.assert_close(product.mean, m + gain @ (y - w @ m - b), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(product.covariance_matrix, s - gain @ w @ s, rtol=1e-4, atol=1e-4)
    factor = ProbedPrior(inner, matrix, offset).double()()
    assert isinstance(factor, GaussianFactor)
    precision = w.mT @ torch.linalg.inv(r) @ w
    torch.testing.assert_close(factor.precision, precision, rtol=1e-4, atol=1e-4)
    # Its exact log-density and its quadratic form agree.
    z = torch.randn(5, 4, generator=generator, dtype=DTYPE)
    torch.testing.assert_close(factor.log_prob(z), GaussianFactor.log_prob(factor, z), rtol=1e-4, atol=1e-4)


def test_a_factor_keeps_its_digits_far_from_the_origin() -> None:
    """In float32 a sharp goal at 1000: the quadratic form would lose all digits."""
    prior = ProbedPrior(GaussianPrior(1, mean=1000.0, std=0.01), torch.tensor([[1.0, 0.0]]))
    z = torch.tensor([[1000.0, 0.0], [1000.0625, 0.0]])
    gap = prior.energy(z)[1] - prior.energy(z)[0]
    assert gap.item() == pytest.approx(0.5 * 6.25**2, rel=1e-4)


def test_products_and_factors_in_the_coordinate() -> None:
    """Pulled back term by term: the log-density of the coordinate, up to a constant."""
    matrix = torch.tensor([[1.0, 0.5, 0.0], [0.0, 1.0, -0.3]])
    wall = RegionPrior(Ball(torch.zeros(2), 1.0), "out", sharpness=2.0)
    sees = ProbedPrior(GaussianPrior(1), torch.tensor([[1.0, 1.0]]))
    z = torch.randn(6, 3)
    for inner in (ProductPrior(wall, GoalPrior(std=0.5)), ProductPrior(wall, SparsityPrior(2)), sees, wall):
        prior = ProbedPrior(inner, matrix, 0.2)
        task = torch.ones(2)
        expected = inner.log_prob(z @ matrix.mT + 0.2, task)
        got = prior.log_prob(z, task)
        torch.testing.assert_close(differences(got), differences(expected), rtol=1e-3, atol=1e-3)
    base = ProbedPrior(ProductPrior(wall, GoalPrior(std=0.5)), matrix)(torch.ones(2))
    assert isinstance(base, Density)
    assert isinstance(base.base, GaussianFactor)
    assert ProbedPrior(ProductPrior(), matrix)().is_flat  # type: ignore[union-attr]


def test_a_fitted_probe() -> None:
    matrix, offset = torch.randn(2, 3), torch.randn(2)
    probe = LinearProbe(matrix.double(), offset.double(), 1.0, 1.0)
    z = torch.randn(4, 3)
    expected = ProbedPrior(GoalPrior(std=0.1), matrix, offset).energy(z, torch.ones(2))
    got = ProbedPrior(GoalPrior(std=0.1), probe).energy(z, torch.ones(2))
    assert torch.equal(got, expected)
    assert got.dtype == torch.float32
    with pytest.raises(ValueError, match="offset must be None for a probe that has its own"):
        ProbedPrior(GoalPrior(std=0.1), probe, offset)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (torch.ones(2, 3), r"matrix must have rank P=2 .* got \(2, 3\)"),
        (torch.randn(3, 2), r"matrix must have rank P=3 .* got \(3, 2\)"),
        (torch.zeros(1, 2), "matrix must have rank P=1"),
        (torch.ones(3), r"matrix must be a finite tensor of shape \(P, D\)"),
        (torch.full((1, 2), math.inf), "matrix must be a finite tensor"),
        (torch.eye(2), "prior must be one of the 2 coordinates"),
    ],
)
def test_bad_probes_are_refused(matrix: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ProbedPrior(GaussianPrior(5) if matrix.shape == (2, 2) else GoalPrior(std=1.0), matrix)


@pytest.mark.parametrize("rows", [1, 3])
def test_a_task_of_another_dtype(rows: int) -> None:
    """Priors in float32, goals in float64: the wider of the two."""
    prior = ProbedPrior(GoalPrior(std=0.5), torch.eye(3)[:rows])
    z, goal = torch.randn(4, 3, dtype=DTYPE), torch.randn(rows, dtype=DTYPE)
    value = prior.log_prob(z, goal)
    assert value.dtype == DTYPE
    torch.testing.assert_close(value, diag_gaussian(goal, 0.5 * torch.ones(1)).log_prob(z[:, :rows]))


def test_a_task_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match="prior must give densities of the 2 coordinates of the probe"):
        ProbedPrior(GoalPrior(std=1.0), torch.eye(2, 3))(torch.zeros(3))
