"""Mixtures against torch's, their gradients against closed forms; ensembles by the law of total variance."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.distributions import (
    Categorical,
    Exponential,
    Independent,
    MixtureSameFamily,
    MultivariateNormal,
    Normal,
)

from torchrl_vjepa.distributions import (
    Ensemble,
    LowRankGaussian,
    Mixture,
    diag_gaussian,
    from_noise,
    full_gaussian,
    log_score,
    maximize_log_prob,
    moments,
    sample,
)

K, D = 3, 2


def parameters(*batch: int, k: int = K, d: int = D, spread: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    """Logits, means and scales that require gradients."""
    logits = torch.randn(*batch, k, dtype=torch.float64)
    loc = spread * torch.randn(*batch, k, d, dtype=torch.float64)
    scale = torch.rand(*batch, k, d, dtype=torch.float64) + 0.5
    return logits.requires_grad_(), loc.requires_grad_(), scale.requires_grad_()


def mixture(logits: Tensor, loc: Tensor, scale: Tensor) -> Mixture:
    return Mixture(logits, diag_gaussian(loc, scale))


def torchs(logits: Tensor, loc: Tensor, scale: Tensor) -> MixtureSameFamily:
    return MixtureSameFamily(Categorical(logits=logits), Independent(Normal(loc, scale), 1))


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_equals_torchs_mixture(batch: tuple[int, ...]) -> None:
    values = parameters(*batch)
    p, q = mixture(*values), torchs(*values)
    z = torch.randn(5, *batch, D, dtype=torch.float64)
    assert (p.batch_shape, p.event_shape) == (q.batch_shape, q.event_shape)
    torch.testing.assert_close(p.log_prob(z), q.log_prob(z))
    torch.testing.assert_close(p.mean, q.mean)
    torch.testing.assert_close(p.variance, q.variance)
    torch.testing.assert_close(p.within_variance + p.between_variance, q.variance)
    torch.testing.assert_close(p.covariance_matrix, moments(q)[1])
    torch.testing.assert_close(p.log_joint(z).softmax(-1).sum(-1), torch.ones_like(p.log_prob(z)))


def test_logits_broadcast_and_are_normalised() -> None:
    loc = torch.randn(4, K, D)
    p = Mixture(torch.tensor([1.0, 2.0, 3.0]) + 100, diag_gaussian(loc, torch.ones(D)))
    torch.testing.assert_close(p.weights, torch.tensor([1.0, 2.0, 3.0]).softmax(0).expand(4, K))


def test_pickles_and_copies() -> None:
    p = mixture(*(value.detach() for value in parameters(4)))
    for twin in (pickle.loads(pickle.dumps(p)), copy.deepcopy(p)):
        assert torch.equal(twin.mean, p.mean)
        assert torch.equal(twin.log_prob(p.mean), p.log_prob(p.mean))


# Draws and their gradients ------------------------------------------------------------------------


def test_components_are_drawn_by_their_weights() -> None:
    centres = torch.tensor([[-50.0], [0.0], [50.0]])
    far = Mixture(torch.tensor([0.1, 0.7, 0.2]).log(), diag_gaussian(centres, torch.ones(1)))
    drawn = sample(far, (100_000,), generator=torch.Generator().manual_seed(0)).squeeze(-1)
    for centre, weight in ((-50, 0.1), (0, 0.7), (50, 0.2)):
        part = ((drawn - centre).abs() < 25).double().mean()
        assert abs(float(part) - weight) < 5 * (weight * (1 - weight) / 100_000) ** 0.5


@pytest.mark.parametrize("spread", [0.0, 1.0, 2.5])
def test_gradients_of_draws_are_those_of_the_moments(spread: float) -> None:
    """E[Z] and E[Z Z^T] have closed forms: so have their gradients by every parameter."""
    values = parameters(spread=spread)
    p = mixture(*values)
    weight = torch.randn(D, D, dtype=torch.float64)
    linear = torch.randn(D, dtype=torch.float64)

    def quantity(z: Tensor) -> Tensor:
        return (z @ weight * z).sum(-1) + z @ linear

    mean, covariance = moments(p)
    exact = torch.autograd.grad((weight * covariance).sum() + quantity(mean), values)
    num, chunks = 4000, 25
    estimates: list[list[Tensor]] = [[], [], []]
    for _ in range(chunks):
        found = torch.autograd.grad(quantity(mixture(*values).rsample((num,))).mean(), values)
        for store, gradient in zip(estimates, found, strict=True):
            store.append(gradient)
    for store, reference in zip(estimates, exact, strict=True):
        stacked = torch.stack(store)
        error = stacked.std(0) / chunks**0.5
        assert ((stacked.mean(0) - reference).abs() < 5 * error + 1e-6).all()


def test_gradient_of_a_draw_keeps_its_quantiles() -> None:
    """In one dimension the implicit gradient is that of the inverse CDF: finite differences of a root."""
    values = parameters(d=1)
    p = mixture(*values)
    noise = torch.tensor([0.3, 0.2], dtype=torch.float64)
    z = p.from_noise(noise)
    gradients = torch.autograd.grad(z.sum(), values)

    def cdf(point: Tensor, *changed: Tensor) -> Tensor:
        logits, loc, scale = changed
        return (logits.softmax(-1) * torch.special.ndtr((point - loc[..., 0]) / scale[..., 0])).sum(-1)

    level = cdf(z, *values).detach()
    for number, (value, gradient) in enumerate(zip(values, gradients, strict=True)):
        for index in range(value.numel()):
            ends = []
            for step in (-1e-5, 1e-5):
                changed = [item.detach().clone() for item in values]
                changed[number].view(-1)[index] += step
                low, high = float(z.detach()) - 1, float(z.detach()) + 1
                for _ in range(60):
                    middle = (low + high) / 2
                    below = cdf(torch.tensor(middle, dtype=torch.float64), *changed) < level
                    low, high = (middle, high) if below else (low, middle)
                ends.append(low)
            assert abs((ends[1] - ends[0]) / 2e-5 - float(gradient.reshape(-1)[index])) < 1e-4


def test_rsample_returns_the_draw_itself() -> None:
    p = mixture(*parameters(4))
    noise = torch.randn(6, 4, D + 1, dtype=torch.float64)
    with torch.no_grad():
        plain = p.from_noise(noise)
    drawn = p.from_noise(noise)
    assert drawn.requires_grad
    assert torch.equal(drawn, plain)
    assert not plain.requires_grad


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_far_out_in_the_tails_are_finite_and_right(dtype: torch.dtype) -> None:
    """A draw 6 standard deviations out moves with its component, to the last digit."""
    loc = torch.tensor([[0.0, 0.0], [1.0, 0.0]], dtype=dtype, requires_grad=True)
    p = Mixture(
        torch.zeros(2, dtype=dtype), diag_gaussian(loc, torch.tensor([[1.0, 1.0], [0.5, 0.5]], dtype=dtype))
    )
    for noise in ([6.0, -6.0, -3.0], [-6.0, 6.0, -3.0]):
        z = p.from_noise(torch.tensor(noise, dtype=dtype))
        (gradient,) = torch.autograd.grad(z.sum(), loc)
        torch.testing.assert_close(
            gradient, torch.tensor([[1.0, 1.0], [0.0, 0.0]], dtype=dtype), rtol=1e-2, atol=1e-2
        )


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_gradients_of_weights_keep_their_digits_in_both_tails(side: float) -> None:
    """Five standard deviations out, 1 minus the distribution function has no digits left in float32."""
    found = []
    for dtype in (torch.float32, torch.float64):
        logits = torch.zeros(2, dtype=dtype, requires_grad=True)
        loc = torch.tensor([[-0.5, 0.0], [0.5, 0.3]], dtype=dtype)
        p = Mixture(logits, diag_gaussian(loc, torch.ones(2, dtype=dtype)))
        z = p.from_noise(side * torch.tensor([5.0, 5.0, -0.5], dtype=dtype))
        found.append(torch.autograd.grad(z.sum(), logits)[0].double())
    torch.testing.assert_close(found[0], found[1], rtol=1e-3, atol=0)


def test_components_without_densities_in_closed_form_have_no_gradient() -> None:
    loc = torch.randn(2, D, requires_grad=True)
    p = Mixture(torch.zeros(2), full_gaussian(loc, torch.eye(D)))
    assert not p.has_rsample
    assert not p.from_noise(torch.randn(5, D + 1)).requires_grad
    assert mixture(*parameters()).has_rsample


# The mode -----------------------------------------------------------------------------------------


@settings(max_examples=10)
@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(1, 3), st.floats(0.1, 6.0))
def test_mode_is_at_least_what_a_search_finds(seed: int, k: int, d: int, spread: float) -> None:
    torch.manual_seed(seed)
    values = [value.detach() for value in parameters(3, k=k, d=d, spread=spread)]
    p = mixture(*values)
    mode = p.mode
    _, found = maximize_log_prob(p)
    assert (p.log_prob(mode) >= found - 1e-4).all()
    step = torch.autograd.functional.jacobian(lambda z: p.log_prob(z).sum(), mode)
    assert (step.abs() * p.stddev < 0.05).all()


def test_mode_of_far_components_is_the_highest_peak() -> None:
    loc = torch.tensor([[0.0, 0.0], [100.0, 100.0]])
    scale = torch.tensor([[1.0, 1.0], [0.1, 0.1]])
    p = Mixture(torch.tensor([0.9, 0.1]).log(), diag_gaussian(loc, scale))
    # Less mass, but a hundred times the density.
    torch.testing.assert_close(p.mode, loc[1])
    assert (p.mean - loc[0]).norm() < 20


def test_mode_has_the_gradient_of_its_condition() -> None:
    values = parameters(d=1)
    mode = mixture(*values).mode
    for number, value in enumerate(values):
        (gradient,) = torch.autograd.grad(mode.sum(), value, retain_graph=True)
        changed = [item.detach().clone() for item in values]
        changed[number].view(-1)[0] += 1e-5
        difference = (mixture(*changed).mode - mode.detach()) / 1e-5
        assert abs(float(difference) - float(gradient.reshape(-1)[0])) < 1e-3


# Ensembles ----------------------------------------------------------------------------------------

MEMBERS: dict[str, Callable[[Tensor], torch.distributions.Distribution]] = {
    "diagonal": lambda loc: diag_gaussian(loc, torch.full_like(loc, 0.5)),
    "full": lambda loc: full_gaussian(loc, 0.5 * torch.eye(loc.shape[-1], dtype=loc.dtype)),
    "low rank": lambda loc: LowRankGaussian(
        loc, torch.full_like(loc, 0.3).unsqueeze(-1), torch.full_like(loc, 0.4)
    ),
}


@pytest.mark.parametrize("kind", MEMBERS)
def test_variances_of_an_ensemble_add_up(kind: str) -> None:
    loc = torch.randn(5, 4, D, dtype=torch.float64)
    p = Ensemble(MEMBERS[kind](loc))
    torch.testing.assert_close(p.epistemic_variance, loc.var(-2, correction=0))
    torch.testing.assert_close(p.aleatoric_variance, torch.full((5, D), 0.25, dtype=torch.float64))
    torch.testing.assert_close(p.variance, p.aleatoric_variance + p.epistemic_variance)
    torch.testing.assert_close(p.mean, loc.mean(-2))


@pytest.mark.parametrize("kind", MEMBERS)
def test_members_that_agree_know(kind: str) -> None:
    p = Ensemble(MEMBERS[kind](torch.ones(4, D, dtype=torch.float64)))
    torch.testing.assert_close(p.epistemic_variance, torch.zeros(D, dtype=torch.float64))
    value = torch.randn(7, D, dtype=torch.float64)
    torch.testing.assert_close(p.log_prob(value), p.components.log_prob(value.unsqueeze(-2))[..., 0])
    torch.testing.assert_close(log_score(p, value), p.log_prob(value))


@pytest.mark.parametrize("kind", MEMBERS)
def test_draws_of_an_ensemble_have_pathwise_gradients(kind: str) -> None:
    """Of the moments, exactly as many draws as each member has."""
    loc = torch.randn(4, D, dtype=torch.float64, requires_grad=True)
    drawn = Ensemble(MEMBERS[kind](loc)).rsample((40_000,))
    (gradient,) = torch.autograd.grad(drawn.mean(0).sum(), loc)
    assert ((gradient - 0.25).abs() < 5 * (0.25 * 0.75 / 40_000) ** 0.5).all()
    assert abs(float(gradient.sum()) - D) < 1e-9


def test_log_score_is_the_mean_of_the_members_likelihoods() -> None:
    p = Ensemble(MEMBERS["diagonal"](torch.randn(5, 4, D)))
    value = torch.randn(5, D)
    members = [Normal(p.components.mean[:, m], 0.5).log_prob(value).sum(-1) for m in range(4)]
    torch.testing.assert_close(log_score(p, value), torch.stack(members).mean(0))
    assert (log_score(p, value) <= p.log_prob(value) + 1e-6).all()
    q = diag_gaussian(torch.zeros(5, D), torch.ones(D))
    assert torch.equal(log_score(q, value), q.log_prob(value))


# Bad input ----------------------------------------------------------------------------------------


def _unit(*shape: int) -> Independent:
    return diag_gaussian(torch.zeros(*shape), torch.ones(1))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: Mixture(torch.zeros(3), diag_gaussian(torch.zeros(2, 1), torch.ones(1))),
            r"\(\*B, K\) with K=2",
        ),
        (
            lambda: Mixture(torch.zeros(3), diag_gaussian(torch.zeros(1), torch.ones(1))),
            "components must have batch",
        ),
        (
            lambda: Mixture(torch.zeros(3), Normal(torch.zeros(3), torch.ones(3))),
            "components must have batch",
        ),
        (
            lambda: Mixture(torch.zeros(2), Independent(Exponential(torch.ones(2, 1)), 1)),
            "transforms of normal noise, got Independent",
        ),
    ],
)
def test_bad_components_are_refused(make: Callable[[], Mixture], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_noise_of_another_size_is_refused() -> None:
    p = mixture(*parameters(4))
    with pytest.raises(ValueError, match=r"noise must have shape \(\*S, \*B, 3\), got \(4, 2\)"):
        from_noise(p, torch.zeros(4, D))
    with pytest.raises(TypeError, match="p must be a transform of normal noise, got Independent; use sample"):
        from_noise(Independent(Exponential(torch.ones(2)), 1), torch.zeros(2))


def test_from_noise_of_torchs_gaussians() -> None:
    root = torch.tensor([[2.0, 0.0], [1.0, 1.0]])
    p = MultivariateNormal(torch.ones(2), scale_tril=root)
    torch.testing.assert_close(from_noise(p, torch.ones(3, 2)), torch.tensor([[3.0, 3.0]]).expand(3, 2))
    q = Independent(Normal(torch.ones(2), 2 * torch.ones(2)), 1)
    torch.testing.assert_close(from_noise(q, torch.ones(2)), torch.full((2,), 3.0))
    assert math.isclose(float(from_noise(q, torch.zeros(2)).sum()), 2.0)
