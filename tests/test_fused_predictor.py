"""``FusedPredictor``: any head with any prior, tasks in tensordicts, statistics, refusals."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_vjepa import (
    BJEPA,
    DeltaHead,
    Density,
    DiagGaussianHead,
    EnsembleHead,
    FlowHead,
    FullGaussianHead,
    FusedPredictor,
    GaussianFactor,
    GaussianPrior,
    LatentModel,
    LowRankGaussianHead,
    MixtureHead,
    Predictor,
    Prior,
    diag_gaussian,
    linear_encoder,
    point_estimate,
    product_of_experts,
    rollout,
)

D, A = 3, 2
HEADS: dict[str, Any] = {
    "diagonal": DiagGaussianHead,
    "full": FullGaussianHead,
    "low rank": lambda: LowRankGaussianHead(1),
    "mixture": lambda: MixtureHead(2),
    "ensemble": lambda: EnsembleHead(num_members=2),
    "flow": FlowHead,
}


def energy(z: Tensor) -> Tensor:
    return 2.0 * (z[..., 0] - 0.5).square()


def quadratic() -> GaussianFactor:
    """The same as :func:`energy`, as a factor."""
    unit = torch.tensor([1.0, 0.0, 0.0])
    return GaussianFactor(4.0 * torch.diag(unit), 2.0 * unit, -0.5)


class Goal(Prior):
    """A Gaussian around the task."""

    def __init__(self, task_key: str = "goal") -> None:
        super().__init__(task_key=task_key, latent_dim=D)

    def forward(self, task: Any = None) -> Any:
        return diag_gaussian(self.own_task(task), torch.full((D,), 0.5))


def constant() -> Density:
    """A prior may be any function."""
    return Density(energy)


@pytest.mark.parametrize("head", HEADS)
def test_any_head_with_an_energy(head: str) -> None:
    """A quadratic energy by importance weights is the Gaussian factor; gradients reach latent and action."""
    torch.manual_seed(1)
    predictor = Predictor(D, A, head=HEADS[head]())
    latent, action = torch.randn(4, D).requires_grad_(), torch.randn(4, A).requires_grad_()
    soft = FusedPredictor(predictor, constant, num_particles=5000).fuse(latent, action)
    assert soft.effective_sample_size is not None
    error = 5 * predictor.dist(latent, action).stddev / soft.effective_sample_size.sqrt().unsqueeze(-1)
    if head == "flow":
        again = FusedPredictor(predictor, quadratic(), num_particles=5000).fuse(latent, action)
        error = 2 * error
    else:
        again = FusedPredictor(predictor, quadratic()).fuse(latent, action)
        assert again.effective_sample_size is None
    assert ((soft.posterior.mean - again.posterior.mean).abs() < error).all()
    assert ((soft.log_evidence - again.log_evidence).abs() < 0.1).all()
    for fusion in (soft, again):
        gradients = torch.autograd.grad(
            fusion.posterior.mean.square().sum() + fusion.log_evidence.sum(),
            (latent, action),
            retain_graph=True,
        )
        assert all(bool(g.isfinite().all()) and bool(g.any()) for g in gradients)
    flat = FusedPredictor(predictor, None).dist(latent, action)
    assert torch.equal(flat.mean, predictor.dist(latent, action).mean)


def test_a_flat_density_is_the_predictor_bit_for_bit() -> None:
    predictor = Predictor(D, A)
    latent, action = torch.randn(4, D), torch.randn(4, A)
    likelihood = predictor.dist(latent, action)
    for prior in (None, Density(), Density):
        fusion = FusedPredictor(predictor, prior).fuse(latent, action)
        assert torch.equal(fusion.posterior.mean, likelihood.mean)
        assert torch.equal(fusion.posterior.variance, likelihood.variance)
        assert torch.equal(fusion.log_evidence, torch.zeros(4))


def test_reads_the_task_of_the_next_step() -> None:
    fused = FusedPredictor(Predictor(D, A), Goal(), return_stats=True)
    assert fused.in_keys == ["latent", "action", "goal"]
    latent, action, goals = torch.randn(4, D), torch.randn(4, A), torch.randn(4, 5, D)
    data = TensorDict(latent=latent, action=action, batch_size=4)
    expected = product_of_experts(
        fused.predictor.dist(latent, action), diag_gaussian(goals[:, 0], torch.full((D,), 0.5))
    )
    for task in (goals, goals[:, 0]):
        out = fused(data.clone().set("goal", task))
        torch.testing.assert_close(out["next", "latent"], expected.mean)
        assert out["fusion_stats", "log_evidence"].shape == (4,)
        assert torch.equal(out["fusion_stats", "effective_sample_size"], torch.full((4,), 128.0))
    assert set(fused.out_keys) <= set(out.keys(True))
    torch.testing.assert_close(fused.dist(latent, action, task=goals[:, 0]).mean, expected.mean)
    torch.testing.assert_close(fused.dist(latent, action, task={"goal": goals[:, 0]}).mean, expected.mean)
    with pytest.raises(KeyError, match="FusedPredictor reads the entry 'goal'"):
        fused(data.clone())
    with pytest.raises(ValueError, match="task must be given to Goal, got None"):
        fused.dist(latent, action)


def test_a_task_may_be_what_the_predictor_reads_too() -> None:
    fused = FusedPredictor(Predictor(D, side_info_dim=D), Goal("side_info"))
    assert fused.in_keys == ["latent", "side_info"]
    data = TensorDict(latent=torch.randn(4, D), side_info=torch.randn(4, D), batch_size=4)
    expected = fused.dist(data["latent"], side_info=data["side_info"], task=data["side_info"]).mean
    torch.testing.assert_close(fused(data)["next", "latent"], expected)


def test_a_bound_prior_makes_a_transition_of_latent_and_action() -> None:
    goal = torch.randn(D)
    fused = FusedPredictor(Predictor(D, A), Goal().bind(goal))
    assert fused.in_keys == ["latent", "action"]
    latents = rollout(fused.dist, torch.randn(4, D), torch.randn(4, 6, A))
    assert latents.shape == (4, 6, D)
    model = LatentModel(linear_encoder(5, D), FusedPredictor(Predictor(D, A), Goal()))
    assert model.in_keys == ["observation", "action", "goal"]
    data = TensorDict(
        observation=torch.randn(4, 5), action=torch.randn(4, A), goal=goal.expand(4, D), batch_size=4
    )
    assert model(data)["next", "latent"].shape == (4, D)


@pytest.mark.parametrize("how", ["mean", "mode", "sample"])
def test_statistics_and_points_of_an_importance_weighted_posterior(how: Any) -> None:
    generator = torch.Generator().manual_seed(0)
    fused = FusedPredictor(
        Predictor(D, A, how=how), constant, num_particles=32, return_stats=True, generator=generator
    )
    data = TensorDict(latent=torch.randn(4, D), action=torch.randn(4, A), batch_size=4)
    out = fused(data)
    size = out["fusion_stats", "effective_sample_size"]
    assert ((size >= 1) & (size < 32)).all()
    generator = torch.Generator().manual_seed(0)
    fusion = fused.fuse(data["latent"], data["action"], generator=generator)
    torch.testing.assert_close(
        out["next", "latent"], point_estimate(fusion.posterior, how, generator=generator)
    )
    torch.testing.assert_close(out["fusion_stats", "log_evidence"], fusion.log_evidence)


def test_randomness_comes_from_the_generator() -> None:
    latent = torch.randn(4, D)
    predictor = Predictor(D)

    def mean(seed: int) -> Tensor:
        return (
            FusedPredictor(predictor, constant, generator=torch.Generator().manual_seed(seed))
            .dist(latent)
            .mean
        )

    before = torch.get_rng_state()
    assert torch.equal(mean(0), mean(0))
    assert not torch.equal(mean(0), mean(1))
    assert torch.equal(before, torch.get_rng_state())
    fused = FusedPredictor(predictor, constant)
    one, other = (fused.fuse(latent, generator=torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(one.log_evidence, other.log_evidence)
    same = fused.fuse(latent[:1].expand(2, 4, D), shared_noise=True)
    assert torch.equal(same.log_evidence[0], same.log_evidence[0, :1].expand(4))
    assert not torch.equal(same.log_evidence[0], same.log_evidence[1])


def test_copies_and_pickles_with_a_generator() -> None:
    fused = FusedPredictor(Predictor(D), constant, generator=torch.Generator().manual_seed(0))
    twins = [copy.deepcopy(fused), pickle.loads(pickle.dumps(fused))]
    latent = torch.randn(4, D)
    expected = fused.dist(latent).mean
    for twin in twins:
        assert torch.equal(twin.dist(latent).mean, expected)


def test_bjepa_hands_its_arguments_on() -> None:
    model = BJEPA(linear_encoder(5, D), Predictor(D))
    generator = torch.Generator()
    fused = model.fuse(constant, num_particles=7, generator=generator, return_stats=True)
    assert (fused.num_particles, fused.generator, fused.return_stats) == (7, generator, True)
    assert model.fuse().prior is model.structural_prior


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: GaussianPrior(2), ValueError, "latent size of the predictor, 3, got 2"),
        (
            lambda: diag_gaussian(torch.zeros(4), torch.ones(4)),
            ValueError,
            "latent size of the predictor, 3, got 4",
        ),
        (lambda: Density(energy, GaussianFactor(torch.eye(2), torch.zeros(2))), ValueError, "3, got 2"),
        (lambda: "goal", TypeError, "prior must be a Prior, a density over latents, a callable .* got str"),
    ],
)
def test_bad_priors_are_refused_early(make: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        FusedPredictor(Predictor(D), make())


def test_bad_calls_are_refused() -> None:
    with pytest.raises(ValueError, match="num_particles must be at least 1, got 0"):
        FusedPredictor(Predictor(D), None, num_particles=0)
    for prior in (None, constant, Density(energy)):
        with pytest.raises(ValueError, match="task must be None for a prior that takes none"):
            FusedPredictor(Predictor(D), prior).dist(torch.zeros(1, D), task=torch.zeros(D))


def test_a_flat_prior_takes_a_deterministic_predictor() -> None:
    predictor = Predictor(D, head=DeltaHead())
    latent = torch.randn(4, D)
    fused = FusedPredictor(predictor, Density())
    assert torch.equal(fused.dist(latent).mean, predictor.dist(latent).mean)
    assert torch.equal(fused.fuse(latent).posterior.mean, predictor.dist(latent).mean)
