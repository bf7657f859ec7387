"""GaussianPrior against torch.distributions: fixed and learned, diagonal and full."""

from __future__ import annotations

import copy
import math
import pickle
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, MultivariateNormal, Normal

from torchrl_vjepa import GaussianPrior

D = 3
MEAN = torch.tensor([1.0, -2.0, 0.5])
STD = torch.tensor([0.1, 2.0, 1.5])
COVARIANCE = torch.tensor([[2.0, 0.6, -0.3], [0.6, 1.0, 0.2], [-0.3, 0.2, 0.5]])

KINDS: dict[str, dict[str, Any]] = {
    "unit": {},
    "numbers": {"mean": 2.0, "std": 0.5},
    "diagonal": {"mean": MEAN, "std": STD},
    "full": {"mean": MEAN, "covariance": COVARIANCE},
}
EVERY = pytest.mark.parametrize("kind", KINDS)
BOTH = pytest.mark.parametrize("learnable", [False, True])


def moments(kind: str) -> tuple[Tensor, Tensor]:
    """Mean and covariance that the arguments mean."""
    arguments = KINDS[kind]
    mean = torch.as_tensor(arguments.get("mean", 0.0)).expand(D)
    std = torch.as_tensor(arguments.get("std", 1.0)).expand(D)
    return mean, arguments.get("covariance", torch.diag(std**2))


@EVERY
@BOTH
def test_density_equals_torch(kind: str, learnable: bool) -> None:
    prior = GaussianPrior(D, **KINDS[kind], learnable=learnable)
    mean, covariance = moments(kind)
    latent = torch.randn(5, 2, D)
    torch.testing.assert_close(
        prior.log_prob(latent), MultivariateNormal(mean, covariance).log_prob(latent), rtol=1e-4, atol=1e-4
    )
    p = prior()
    assert isinstance(p, MultivariateNormal if kind == "full" else Independent)
    assert p.batch_shape == ()
    assert p.event_shape == (D,)
    torch.testing.assert_close(p.mean, mean)
    torch.testing.assert_close(p.variance, covariance.diagonal())
    assert prior(torch.ones(7)).mean.shape == (D,)  # a static prior reads no task


@EVERY
def test_what_is_learned(kind: str) -> None:
    fixed, learned = GaussianPrior(D, **KINDS[kind]), GaussianPrior(D, **KINDS[kind], learnable=True)
    assert not list(fixed.parameters())
    names = {"mean", "log_diagonal", "lower"} if kind == "full" else {"mean", "log_var"}
    assert {name for name, _ in learned.named_parameters()} == names
    assert set(fixed.state_dict()) == set(learned.state_dict()) == names
    assert all(parameter.is_leaf for parameter in learned.parameters())


@pytest.mark.parametrize("kind", ["diagonal", "full"])
def test_learns_the_moments_of_samples(kind: str) -> None:
    """Maximum likelihood: the sample mean, and the sample (co)variance."""
    x = torch.randn(400, D) @ torch.linalg.cholesky(COVARIANCE).mT + MEAN
    prior = GaussianPrior(D, learnable=True, **({"covariance": torch.eye(D)} if kind == "full" else {}))
    optimizer = torch.optim.LBFGS(prior.parameters(), max_iter=200, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = -prior.log_prob(x).mean()
        loss.backward()
        return loss

    optimizer.step(closure)
    expected = torch.cov(x.mT, correction=0)
    p = prior()
    torch.testing.assert_close(p.mean, x.mean(0), rtol=1e-3, atol=1e-3)
    ours = p.covariance_matrix if kind == "full" else p.variance.diag()
    torch.testing.assert_close(
        ours, expected if kind == "full" else expected.diagonal().diag(), rtol=5e-3, atol=5e-3
    )


@EVERY
@BOTH
def test_reset_goes_back_to_what_was_given(kind: str, learnable: bool) -> None:
    arguments = copy.deepcopy(KINDS[kind])
    prior = GaussianPrior(D, **arguments, learnable=learnable)
    for value in arguments.values():
        if isinstance(value, Tensor):
            value.fill_(9.0)  # the caller's tensors are the caller's
    before = copy.deepcopy(prior.state_dict())
    with torch.no_grad():
        for value in (*prior.parameters(), *prior.buffers()):
            value.fill_(7.0)
    prior.reset_parameters()
    torch.testing.assert_close(prior.state_dict(), before, rtol=0, atol=0)
    torch.testing.assert_close(prior().mean, moments(kind)[0])
    prior.double().reset_parameters()
    assert prior().mean.dtype == torch.float64


@EVERY
@BOTH
def test_copies_and_pickles(kind: str, learnable: bool) -> None:
    prior = GaussianPrior(D, **KINDS[kind], learnable=learnable)
    latent = torch.randn(4, D)
    for twin in (copy.deepcopy(prior), pickle.loads(pickle.dumps(prior))):
        assert torch.equal(twin.log_prob(latent), prior.log_prob(latent))
        twin.reset_parameters()
        assert torch.equal(twin.log_prob(latent), prior.log_prob(latent))


@BOTH
def test_arguments_with_a_graph_or_another_dtype(learnable: bool) -> None:
    """A prior is a constant of the graph that made its arguments, in the default dtype."""
    tensors = {"mean": MEAN.double(), "covariance": COVARIANCE.double()}
    tensors = {name: (1.0 * value.requires_grad_()) for name, value in tensors.items()}
    prior = GaussianPrior(D, **tensors, learnable=learnable)
    assert all(value.dtype == torch.float32 for value in prior.state_dict().values())
    copy.deepcopy(prior)  # tensors that carry a graph refuse this
    assert prior.log_prob(torch.zeros(D)).requires_grad == learnable
    assert GaussianPrior(1, mean=2, std=1)().mean.dtype == torch.float32


def test_the_upper_triangle_is_no_freedom() -> None:
    prior = GaussianPrior(D, covariance=COVARIANCE, learnable=True)
    before = prior.log_prob(MEAN).detach()
    with torch.no_grad():
        prior.lower.add_(torch.ones(D, D).triu())
    assert torch.equal(prior.log_prob(MEAN), before)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"latent_dim": 0}, "latent_dim must be positive, got 0"),
        ({"std": 1.0, "covariance": COVARIANCE}, "at most one of std and covariance must be given, got both"),
        ({"std": 0.0}, "std must be positive, got"),
        ({"std": torch.tensor([1.0, -1.0, 1.0])}, "std must be positive, got"),
        ({"std": torch.ones(2)}, r"std must be a finite number or a tensor of shape \(3,\)"),
        ({"std": math.nan}, "std must be a finite number"),
        ({"mean": math.inf}, "mean must be a finite number"),
        ({"mean": torch.zeros(1, 3)}, r"mean must be a finite number or a tensor of shape \(3,\)"),
        ({"covariance": torch.eye(2)}, r"covariance must have shape \(3, 3\), got \(2, 2\)"),
        ({"covariance": torch.ones(3)}, r"covariance must have shape \(3, 3\), got \(3,\)"),
        ({"covariance": torch.ones(3, 3)}, "covariance must be symmetric positive definite"),
        ({"covariance": -torch.eye(3)}, "covariance must be symmetric positive definite"),
        ({"covariance": torch.eye(3) + 0.1 * torch.ones(3, 3).tril(-1)}, "must be symmetric positive"),
        ({"covariance": torch.eye(3) * math.nan}, "covariance must be symmetric positive definite"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GaussianPrior(**{"latent_dim": D, **arguments})


def test_a_fixed_prior_pulls_towards_its_mean() -> None:
    """-log p is the constraint cost of a goal: its gradient is the precision-weighted error."""
    prior = GaussianPrior(D, mean=MEAN, covariance=COVARIANCE)
    latent = torch.zeros(2, D, requires_grad=True)
    prior.log_prob(latent).sum().backward()
    expected = torch.linalg.solve(COVARIANCE, MEAN).expand(2, D)
    torch.testing.assert_close(latent.grad, expected, rtol=1e-4, atol=1e-4)
    diagonal = GaussianPrior(D, mean=MEAN, std=STD).log_prob(torch.zeros(D))
    torch.testing.assert_close(diagonal, Normal(MEAN, STD).log_prob(torch.zeros(D)).sum())
