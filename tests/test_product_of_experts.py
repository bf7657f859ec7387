"""Product of Gaussian experts against grids, NumPy and the Kalman filter; and its fused predictor."""

from __future__ import annotations

import copy
import itertools
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import Beta, Distribution, Independent, MultivariateNormal, Normal

from torchrl_vjepa import (
    BJEPA,
    Delta,
    DeltaHead,
    FusedPredictor,
    GaussianPrior,
    LatentModel,
    Predictor,
    diag_gaussian,
    linear_encoder,
    product_of_experts,
    rollout,
)

D = 3
KINDS = list(itertools.product(["diagonal", "full"], repeat=2)) + [("diagonal",), ("full",)]
KINDS += [("full", "diagonal", "diagonal", "full"), ("diagonal",) * 3, ("full",) * 3]


def expert(kind: str, *batch: int, dim: int = D) -> Distribution:
    loc = torch.randn(*batch, dim, dtype=torch.float64)
    root = torch.randn(*batch, dim, dim, dtype=torch.float64)
    if kind == "diagonal":
        return diag_gaussian(loc, root.square().sum(-1).sqrt())
    return MultivariateNormal(loc, root @ root.mT + 0.3 * torch.eye(dim, dtype=torch.float64))


def covariance(p: Distribution) -> Tensor:
    return p.covariance_matrix if isinstance(p, MultivariateNormal) else torch.diag_embed(p.variance)


def assert_same(one: Distribution, other: Distribution) -> None:
    torch.testing.assert_close(one.mean, other.mean, rtol=1e-7, atol=1e-8)
    torch.testing.assert_close(covariance(one), covariance(other), rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("kinds", KINDS)
def test_equals_the_normalised_product_of_densities_on_a_grid(kinds: tuple[str, ...]) -> None:
    experts = [expert(kind, dim=2) for kind in kinds]
    p = product_of_experts(*experts)
    ticks = torch.linspace(-9.0, 9.0, 361, dtype=torch.float64)
    axes = [ticks * s + m for m, s in zip(p.mean, p.stddev, strict=True)]
    grid = torch.cartesian_prod(*axes)
    cell = (axes[0][1] - axes[0][0]) * (axes[1][1] - axes[1][0])
    density = torch.stack([q.log_prob(grid) for q in experts]).sum(0).exp()
    density = density / (density.sum() * cell)
    torch.testing.assert_close(p.log_prob(grid).exp(), density, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("kinds", KINDS)
def test_equals_the_information_form(kinds: tuple[str, ...]) -> None:
    experts = [expert(kind, 4) for kind in kinds]
    p = product_of_experts(*experts)
    assert isinstance(p, MultivariateNormal if "full" in kinds else Independent)
    assert p.batch_shape == (4,)
    assert p.event_shape == (D,)
    for b in range(4):
        precisions = [np.linalg.inv(covariance(q)[b].numpy()) for q in experts]
        information = sum(m @ q.mean[b].numpy() for m, q in zip(precisions, experts, strict=True))
        np.testing.assert_allclose(covariance(p)[b], np.linalg.inv(sum(precisions)), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(p.mean[b], np.linalg.solve(sum(precisions), information), rtol=1e-9)


@pytest.mark.parametrize("kinds", [kinds for kinds in KINDS if len(kinds) == 2])
def test_equals_the_kalman_update(kinds: tuple[str, str]) -> None:
    """Belief N(m, P), measurement z = x + v with v ~ N(0, R): gain, mean and Joseph covariance."""
    belief, measurement = (expert(kind) for kind in kinds)
    prior, noise = covariance(belief), covariance(measurement)
    gain = prior @ torch.linalg.inv(prior + noise)
    rest = torch.eye(D, dtype=torch.float64) - gain
    p = product_of_experts(belief, measurement)
    torch.testing.assert_close(p.mean, belief.mean + gain @ (measurement.mean - belief.mean))
    torch.testing.assert_close(covariance(p), rest @ prior @ rest.mT + gain @ noise @ gain.mT)


@given(
    kinds=st.lists(st.sampled_from(["diagonal", "full"]), min_size=3, max_size=5),
    order=st.randoms(use_true_random=False),
    cut=st.integers(1, 4),
    seed=st.integers(0, 2**31),
)
def test_any_order_and_any_grouping(kinds: list[str], order: Any, cut: int, seed: int) -> None:
    torch.manual_seed(seed)
    experts = [expert(kind) for kind in kinds]
    reference = product_of_experts(*experts)
    shuffled = list(experts)
    order.shuffle(shuffled)
    assert_same(product_of_experts(*shuffled), reference)
    cut = min(cut, len(experts) - 1)
    grouped = product_of_experts(product_of_experts(*experts[:cut]), product_of_experts(*experts[cut:]))
    assert_same(grouped, reference)


@given(count=st.integers(1, 6), seed=st.integers(0, 2**31), full=st.booleans())
def test_agreement_sharpens(count: int, seed: int, full: bool) -> None:
    """n copies of one expert: its mean, and its covariance over n; one alone is itself."""
    torch.manual_seed(seed)
    one = expert("full" if full else "diagonal")
    p = product_of_experts(*[one] * count)
    torch.testing.assert_close(p.mean, one.mean, rtol=1e-7, atol=1e-8)
    torch.testing.assert_close(covariance(p), covariance(one) / count, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("kinds", [("diagonal", "diagonal"), ("diagonal", "full"), ("full", "diagonal")])
def test_batches_broadcast(kinds: tuple[str, str]) -> None:
    one, other = expert(kinds[0], 5, 1), expert(kinds[1], 4)
    p = product_of_experts(one, other)
    assert p.batch_shape == (5, 4)
    assert p.mean.shape == (5, 4, D)
    single = product_of_experts(one.expand((5, 4)), other.expand((5, 4)))
    assert_same(p, single)


def test_gradients_reach_every_expert() -> None:
    values = [torch.randn(D, dtype=torch.float64) for _ in range(4)]
    values += [torch.randn(D, D, dtype=torch.float64).tril(-1)]

    def moments(*tensors: Tensor) -> tuple[Tensor, Tensor]:
        loc, log_scale, other, log_diagonal, lower = tensors
        tril = lower.tril(-1) + torch.diag_embed(log_diagonal.exp())
        p = product_of_experts(
            diag_gaussian(loc, log_scale.exp()), MultivariateNormal(other, scale_tril=tril)
        )
        return p.mean, p.covariance_matrix

    assert torch.autograd.gradcheck(moments, [v.requires_grad_() for v in values])


def test_vmap_equals_a_loop() -> None:
    loc, scale = torch.randn(5, D), torch.rand(5, D) + 0.5
    factor = torch.linalg.cholesky(covariance(expert("full", 5)).float())

    def mean(loc: Tensor, scale: Tensor, factor: Tensor) -> Tensor:
        full = MultivariateNormal(-loc, scale_tril=factor, validate_args=False)
        return product_of_experts(diag_gaussian(loc, scale), full).mean

    each = [mean(*row) for row in zip(loc, scale, factor, strict=True)]
    torch.testing.assert_close(torch.func.vmap(mean)(loc, scale, factor), torch.stack(each))


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (list, ValueError, "experts must be at least one Gaussian, got none"),
        (lambda: [expert("diagonal"), expert("full", dim=2)], ValueError, r"\(D,\), got \[\(3,\), \(2,\)\]"),
        (lambda: [Normal(torch.zeros(3), torch.ones(3))], ValueError, r"\(D,\), got \[\(\)\]"),
        (
            lambda: [Independent(Normal(torch.zeros(4, 3), torch.ones(4, 3)), 2)],
            ValueError,
            r"\(D,\), got \[\(4, 3\)\]",
        ),
        (
            lambda: [expert("diagonal"), Delta(torch.zeros(3))],
            TypeError,
            "must be diagonal or multivariate Gaussians, got .*'Delta'",
        ),
        (lambda: [Independent(Beta(torch.ones(3), torch.ones(3)), 1)], TypeError, "Gaussians, got"),
    ],
)
def test_bad_experts_are_refused(make: Callable[[], list[Any]], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        product_of_experts(*make())


# --- the fused predictor

ACTION, SIDE = 2, 4


def make_predictor(**kwargs: Any) -> Predictor:
    return Predictor(D, ACTION, skips=(1, 2), side_info_dim=SIDE, **kwargs)


def inputs(skip: int = 1) -> dict[str, Tensor]:
    return {
        "latent": torch.randn(5, D),
        "action": torch.randn(5, skip, ACTION),
        "side_info": torch.randn(5, SIDE),
    }


def test_a_flat_prior_gives_the_predictor_bit_for_bit() -> None:
    predictor = make_predictor()
    fused = FusedPredictor(predictor, None)
    for skip in (1, 2):
        ours, theirs = (
            module.dist(**inputs_, skip=skip) for inputs_ in [inputs(skip)] for module in (fused, predictor)
        )
        assert torch.equal(ours.mean, theirs.mean)
        assert torch.equal(ours.variance, theirs.variance)
    data = TensorDict({**inputs(), "action": torch.randn(5, ACTION)}, batch_size=5)
    assert torch.equal(fused(data.clone())["next", "latent"], predictor(data.clone())["next", "latent"])


def test_mean_is_the_papers_hard_fusion() -> None:
    r"""\mu_post = (s_prior^2 mu_dyn + s_dyn^2 mu_prior) / (s_dyn^2 + s_prior^2)."""
    mean, std = torch.tensor([1.0, 0.0, -3.0]), torch.tensor([0.3, 1.0, 2.0])
    predictor = make_predictor()
    fused = FusedPredictor(predictor, GaussianPrior(D, mean=mean, std=std))
    for skip in (1, 2):
        data = inputs(skip)
        p = predictor.dist(**data, skip=skip)
        post = fused.dist(**data, skip=skip)
        total = p.variance + std**2
        torch.testing.assert_close(post.mean, (std**2 * p.mean + p.variance * mean) / total)
        torch.testing.assert_close(post.variance, p.variance * std**2 / total)


@pytest.mark.parametrize("full", [False, True])
def test_is_a_transition_with_the_predictors_attributes(full: bool) -> None:
    predictor = Predictor(D, ACTION, how="mode", latent_key="z", action_key="u", out_key=("next", "z"))
    kwargs = {"covariance": torch.eye(D) + 0.5} if full else {}
    fused = FusedPredictor(predictor, GaussianPrior(D, mean=1.0, **kwargs))
    for name in ("latent_dim", "action_dim", "side_info_dim", "skips", "how", "latent_key", "action_key"):
        assert getattr(fused, name) == getattr(predictor, name)
    assert (fused.in_keys, fused.out_keys) == (["z", "u"], [("next", "z")])
    data = TensorDict(z=torch.randn(5, D), u=torch.randn(5, ACTION), batch_size=5)
    expected = fused.dist(data["z"], data["u"]).mean
    torch.testing.assert_close(fused(data.clone())["next", "z"], expected)
    actions = torch.randn(5, 4, ACTION)
    assert rollout(fused.dist, data["z"], actions).shape == (5, 4, D)
    assert rollout(fused.dist, data["z"], actions, "sample", num_samples=2).shape == (2, 5, 4, D)
    encoder = linear_encoder(6, D, out_key="z")
    model = LatentModel(encoder, fused)
    out = model(TensorDict(observation=torch.randn(5, 6), u=data["u"], batch_size=5))
    torch.testing.assert_close(out["next", "z"], fused.dist(out["z"], data["u"]).mean)


def test_shares_parameters_and_trains_a_prior_of_its_own() -> None:
    model = BJEPA(linear_encoder(6, D), Predictor(D))
    fused = model.fuse()
    assert fused.predictor is model.predictor
    assert fused.prior is model.structural_prior
    own = {id(p) for p in (*model.predictor.parameters(), *model.structural_prior.parameters())}
    assert {id(p) for p in fused.parameters()} == own
    fused.dist(torch.randn(5, D)).log_prob(torch.randn(5, D)).sum().backward()
    assert all(p.grad.any() for p in fused.parameters() if p.numel())
    goal = GaussianPrior(D, mean=5.0, std=1e-3)
    torch.testing.assert_close(model.fuse(goal).dist(torch.zeros(1, D)).mean, torch.full((1, D), 5.0))


def unit_prior() -> Distribution:
    """A prior may be any function."""
    return diag_gaussian(torch.zeros(D), torch.ones(D))


@pytest.mark.parametrize("prior", [None, unit_prior, GaussianPrior(D, learnable=True)])
def test_copies_and_pickles(prior: Any) -> None:
    fused = FusedPredictor(Predictor(D), prior)
    latent = torch.randn(4, D)
    for twin in (copy.deepcopy(fused), pickle.loads(pickle.dumps(fused))):
        assert torch.equal(twin.dist(latent).mean, fused.dist(latent).mean)


def test_a_deterministic_predictor_cannot_be_fused() -> None:
    fused = FusedPredictor(Predictor(D, head=DeltaHead()), GaussianPrior(D))
    with pytest.raises(TypeError, match="p must have a width for the prior to act on, got a point mass"):
        fused.dist(torch.zeros(1, D))


def test_bad_inputs_are_the_predictors_to_refuse() -> None:
    fused = FusedPredictor(make_predictor(), GaussianPrior(D))
    with pytest.raises(ValueError, match="skip must be one of skips="):
        fused.dist(**inputs(3), skip=3)
    with pytest.raises(KeyError, match="FusedPredictor reads the entry 'latent'"):
        fused(TensorDict(batch_size=3))
