"""``maximize_log_prob`` against known maxima: of distributions, of energies, with several optimisers."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.distributions import (
    Beta,
    Categorical,
    Independent,
    LogNormal,
    MixtureSameFamily,
    MultivariateNormal,
    Normal,
    TransformedDistribution,
)
from torch.distributions.transforms import AffineTransform

from torchrl_vjepa.distributions import (
    diag_gaussian,
    full_gaussian,
    maximize_log_prob,
    point_estimate,
    product_of_experts,
)

OPTIMIZERS: dict[str, Callable[[list[Tensor]], torch.optim.Optimizer] | None] = {
    "default": None,
    "SGD": lambda v: torch.optim.SGD(v, lr=0.3, momentum=0.5),
    "RMSprop": lambda v: torch.optim.RMSprop(v, lr=0.05),
    "LBFGS": lambda v: torch.optim.LBFGS(v, lr=0.5, max_iter=5),
}


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_any_optimizer_finds_the_mode_of_a_gaussian(name: str) -> None:
    p = diag_gaussian(torch.tensor([[1.0, -2.0], [0.0, 30.0]]), torch.tensor([0.01, 10.0]))
    starts = p.mean + 2 * torch.randn(3, 2, 2) * p.stddev
    point, value = maximize_log_prob(p, starts, optimizer=OPTIMIZERS[name])
    assert ((point - p.mean).abs() < 0.05 * p.stddev).all()
    torch.testing.assert_close(value, p.log_prob(point))
    assert not point.requires_grad


def test_likelihood_times_energy_is_the_product_of_experts() -> None:
    """The latent MAP under an energy prior, where the energy is quadratic and the answer is known."""
    likelihood = full_gaussian(torch.randn(5, 3), torch.eye(3) + 0.3 * torch.ones(3, 3).tril(-1))
    goal = diag_gaussian(torch.ones(3), torch.full((3,), 0.5))

    def energy(z: Tensor) -> Tensor:
        return 2 * (z - 1).square().sum(-1)

    point, _ = maximize_log_prob(
        lambda z: likelihood.log_prob(z) - energy(z), likelihood.mean.unsqueeze(0), num_steps=300
    )
    torch.testing.assert_close(point, product_of_experts(likelihood, goal).mean, rtol=0, atol=1e-2)


def test_several_starts_escape_a_local_maximum_row_by_row() -> None:
    def valleys(z: Tensor) -> Tensor:
        # Rows differ in which side is higher.
        tilt = torch.tensor([0.5, -0.5])
        return (-((z**2 - 4) ** 2) + tilt.unsqueeze(-1) * z).sum(-1)

    one, _ = maximize_log_prob(valleys, torch.full((1, 2, 1), 1.9), scale=0.2)
    assert (one > 0).all()
    both, value = maximize_log_prob(
        valleys, torch.tensor([1.9, -1.9]).reshape(2, 1, 1).expand(2, 2, 1), scale=0.2
    )
    assert both.squeeze(-1).sign().tolist() == [1.0, -1.0]
    torch.testing.assert_close(both.abs(), torch.full((2, 1), 2.0), rtol=0, atol=0.05)
    assert value.shape == (2,)


def test_the_result_is_never_worse_than_a_start() -> None:
    p = MultivariateNormal(torch.zeros(2), torch.eye(2))
    starts = torch.randn(4, 7, 2)
    wild = maximize_log_prob(p, starts, optimizer=lambda v: torch.optim.SGD(v, lr=1e3), num_steps=20)
    assert (wild[1] >= p.log_prob(starts).amax(0)).all()
    none = maximize_log_prob(p, starts, num_steps=0)
    torch.testing.assert_close(none[1], p.log_prob(starts).amax(0))


@pytest.mark.parametrize("name", ["default", "LBFGS"])
def test_a_start_that_goes_astray_stops_no_other(name: str) -> None:
    def walled(z: Tensor) -> Tensor:
        return torch.where(z > 5, torch.nan, -(z - 1).square()).sum(-1)

    point, value = maximize_log_prob(walled, torch.tensor([[[9.0]], [[0.0]]]), optimizer=OPTIMIZERS[name])
    torch.testing.assert_close(point, torch.ones(1, 1), rtol=0, atol=0.02)
    assert value.isfinite().all()


def test_modes_of_torchs_own_distributions() -> None:
    mixture = MixtureSameFamily(
        Categorical(torch.tensor([0.4, 0.6])),
        Independent(Normal(torch.tensor([[-3.0, 0.0], [3.0, 1.0]]), torch.ones(2, 2)), 1),
    )
    torch.testing.assert_close(point_estimate(mixture, "mode"), torch.tensor([3.0, 1.0]), rtol=0, atol=0.02)
    base = Independent(Normal(torch.zeros(2), torch.ones(2)), 1)
    moved = TransformedDistribution(base, [AffineTransform(torch.tensor([1.0, 2.0]), 3.0, event_dim=1)])
    torch.testing.assert_close(point_estimate(moved, "mode"), torch.tensor([1.0, 2.0]), rtol=0, atol=0.1)
    lognormal = Independent(LogNormal(torch.zeros(2), torch.ones(2)), 1)
    torch.testing.assert_close(point_estimate(lognormal, "mode"), lognormal.mode)


def test_is_deterministic_and_leaves_the_random_state() -> None:
    p = MixtureSameFamily(
        Categorical(torch.ones(2)), Independent(Normal(torch.randn(2, 2), torch.ones(2, 2)), 1)
    )
    before = torch.get_rng_state()
    assert torch.equal(maximize_log_prob(p)[0], maximize_log_prob(p)[0])
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_works_where_gradients_are_off(mode: Callable[[], object]) -> None:
    with mode():
        p = diag_gaussian(torch.ones(3, 2), torch.ones(2))
        point, _ = maximize_log_prob(p, p.mean.unsqueeze(0) + 1)
    torch.testing.assert_close(point, torch.ones(3, 2), rtol=0, atol=0.02)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: maximize_log_prob(lambda z: -z.square().sum(-1)),
            r"starts must have shape \(S, \*B, D\), got None",
        ),
        (lambda: maximize_log_prob(lambda z: z, torch.zeros(2)), r"starts must have shape .*got \(2,\)"),
        (
            lambda: maximize_log_prob(lambda z: z, torch.zeros(1, 4, 2)),
            r"target must return a tensor of shape \(1, 4\) .* got \(1, 4, 2\)",
        ),
        (
            lambda: maximize_log_prob(lambda z: torch.nan * z.sum(-1), torch.zeros(1, 4, 2)),
            "starts must have a finite log-density in every row, got none in 4 rows",
        ),
        (
            lambda: maximize_log_prob(diag_gaussian(torch.zeros(2), torch.ones(2)), num_steps=-1),
            "num_steps must be",
        ),
    ],
)
def test_bad_input_is_refused(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


def test_beta_has_its_own_mode() -> None:
    p = Independent(Beta(torch.tensor([2.0]), torch.tensor([3.0])), 1)
    torch.testing.assert_close(point_estimate(p, "mode"), torch.tensor([1 / 3]))
