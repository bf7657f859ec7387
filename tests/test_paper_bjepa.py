"""Identities of the paper about BJEPA, fusion and the reconstructing baseline."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import MultivariateNormal
from torchrl.objectives import SoftUpdate

from torchrl_vjepa import (
    BJEPA,
    VAE,
    VJEPA,
    BJEPALoss,
    Density,
    DiagGaussianHead,
    FusedPredictor,
    GaussianFactor,
    GaussianPrior,
    ParticleFilter,
    Predictor,
    Prior,
    TargetScale,
    VAELoss,
    VirtualObservation,
    VJEPALoss,
    diag_gaussian,
    full_gaussian,
    fuse,
    linear_encoder,
    map_estimate,
    product_of_experts,
    propagate_moments,
)


def make_model(observation_dim: int, latent_dim: int, action_dim: int = 0) -> BJEPA:
    """Linear, with a constant predicted variance and a target that is a point mass in all but name."""
    head = DiagGaussianHead("constant", log_var_range=(-40.0, 16.0))
    scale = TargetScale(latent_dim, kind="constant", init_std=1e-9, log_var_range=(-80.0, 16.0))
    predictor = Predictor(latent_dim, action_dim, head=head)
    return BJEPA(linear_encoder(observation_dim, latent_dim), predictor, target_scale=scale).double()


def exact_normal(num: int, dim: int) -> Tensor:
    """Samples with mean exactly zero and covariance exactly the identity."""
    x = torch.randn(num, dim, dtype=torch.float64)
    return torch.linalg.qr(x - x.mean(0)).Q * math.sqrt(num)


def pairs(context: Tensor, target: Tensor) -> TensorDict:
    """One window of two steps per sample."""
    return TensorDict(observation=torch.stack([context, target], 1), batch_size=(len(context), 2))


def minimise(loss: VAELoss | VJEPALoss, windows: TensorDict, steps: int, rate: float) -> None:
    updater = SoftUpdate(loss, eps=0.9) if isinstance(loss, VJEPALoss) else None
    optimizer = torch.optim.Adam(loss.parameters(), rate)
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = rate * (1 - step / steps)
        optimizer.zero_grad()
        sum(value for key, value in loss(windows).items() if key.startswith("loss_")).backward()
        optimizer.step()
        if updater is not None:
            updater.step()


# --- VJEPA as a special case of BJEPA


def test_vjepa_is_bjepa_with_an_uninformative_prior() -> None:
    """eq:bjepa_posterior with p_prior proportional to 1: the posterior is the likelihood itself."""
    model = make_model(6, 3)
    latent = torch.randn(5, 3, dtype=torch.float64)
    likelihood = model.predictor.dist(latent)
    flat = FusedPredictor(model.predictor, None).dist(latent)
    assert torch.equal(flat.mean, likelihood.mean)
    assert torch.equal(flat.variance, likelihood.variance)


def test_a_vague_prior_tends_to_the_uninformative_one() -> None:
    """The fused mean and variance differ by O(1 / sigma_prior^2)."""
    model = make_model(6, 3)
    latent = torch.randn(5, 3, dtype=torch.float64)
    likelihood = model.predictor.dist(latent)
    gaps = []
    for std in (1e1, 1e2, 1e3):
        p = model.fuse(GaussianPrior(3, mean=2.0, std=std).double()).dist(latent)
        gaps.append((p.mean - likelihood.mean).abs().max() + (p.variance - likelihood.variance).abs().max())
    assert gaps[0] > 1e-3
    for wide, wider in zip(gaps, gaps[1:], strict=False):
        assert wider.item() == pytest.approx(wide.item() / 100, rel=0.05)


def test_bjepa_without_the_structural_term_trains_like_vjepa() -> None:
    """eq:bjepa_training_objective with gamma = 0: the same weights after several steps of Adam and EMA."""
    model = make_model(6, 3)
    plain = VJEPA(
        linear_encoder(6, 3), Predictor(3, head=model.predictor.head), target_scale=model.target_scale.module
    ).double()
    plain.encoder.load_state_dict(model.encoder.state_dict())
    plain.predictor.load_state_dict(model.predictor.state_dict())
    windows = TensorDict(observation=torch.randn(8, 5, 6, dtype=torch.float64), batch_size=(8, 5))
    for loss in (BJEPALoss(model, structural_kl_coeff=0.0), VJEPALoss(plain)):
        torch.manual_seed(3)
        minimise(loss, windows, 5, 1e-2)
    shared = {k: v for k, v in model.state_dict().items() if "structural_prior" not in k}
    torch.testing.assert_close(shared, dict(plain.state_dict()), rtol=0, atol=0)


def test_the_structural_term_pulls_the_dynamics_to_the_prior() -> None:
    """Soft fusion with a constant prediction: argmin NLL + gamma KL, in closed form.

    For targets of mean m and variance v and a unit prior: mu = m / (1 + gamma s^2) and
    (1 - gamma) / s^2 + gamma = (v + (m - mu)^2) / s^4.
    """
    gamma, m, v = 0.5, 2.0, 0.3
    model = make_model(2, 1)
    model = BJEPA(
        model.encoder,
        model.predictor,
        structural_prior=GaussianPrior(1).double(),
        target_scale=model.target_scale.module,
    )
    with torch.no_grad():
        model.encoder.module.network.weight.copy_(torch.tensor([[1.0, 0.0]]))
    noise = exact_normal(200, 1)
    # The context is the constant 1, so the trunk's weight is the mean.
    context = torch.ones(200, 2, dtype=torch.float64)
    target = torch.cat([m + math.sqrt(v) * noise, noise], 1)
    loss = BJEPALoss(model, structural_kl_coeff=gamma, target_kl_coeff=0.0, collapse_rank=0.0)
    SoftUpdate(loss, eps=0.9)
    optimizer = torch.optim.LBFGS(model.predictor.parameters(), max_iter=100, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimizer.zero_grad()
        terms = loss(pairs(context, target))
        value = terms["loss_nll"] + terms["loss_structural_kl"]
        value.backward()
        return value

    optimizer.step(closure)
    p = model.predictor.dist(torch.ones(1, 1, dtype=torch.float64))
    s2 = p.variance.item()
    mu = p.mean.item()
    assert mu == pytest.approx(m / (1 + gamma * s2), rel=1e-3)
    assert (1 - gamma) / s2 + gamma == pytest.approx((v + (m - mu) ** 2) / s2**2, rel=1e-3)
    assert mu < m - 0.1


# --- fusion as filtering


def test_hard_fusion_filters_like_kalman() -> None:
    """eq:bjepa_filter. Predict with p_phi, update with a measurement as the prior expert; several steps."""
    model = make_model(5, 2, action_dim=1)
    a = torch.tensor([[0.9, 0.3], [-0.3, 0.8]], dtype=torch.float64)
    b = torch.tensor([[0.5], [1.0]], dtype=torch.float64)
    q = torch.tensor([0.04, 0.25], dtype=torch.float64)
    r = torch.tensor([[0.5, 0.2], [0.2, 0.3]], dtype=torch.float64)
    with torch.no_grad():
        model.predictor.trunks[0].weight.copy_(torch.cat([a, b], 1))
        model.predictor.constants[0].copy_(q.log())
    state = torch.tensor([1.0, -2.0], dtype=torch.float64)
    for _ in range(3):
        u = torch.randn(1, dtype=torch.float64)
        z = torch.randn(2, dtype=torch.float64)
        measurement = GaussianPrior(2, mean=z, covariance=r).double()
        post = model.fuse(measurement).dist(state, u)
        predicted, noise = a @ state + b @ u, q.diag()
        gain = noise @ torch.linalg.inv(noise + r)
        torch.testing.assert_close(post.mean, predicted + gain @ (z - predicted), rtol=1e-5, atol=1e-6)
        covariance = (torch.eye(2, dtype=torch.float64) - gain) @ noise
        torch.testing.assert_close(post.covariance_matrix, covariance, rtol=1e-5, atol=1e-6)
        state = post.mean.detach()


# A system, a virtual sensor of one of its coordinates, and a start.
DYNAMICS = torch.tensor([[0.9, 0.3], [-0.3, 0.8]], dtype=torch.float64)
CONTROL = torch.tensor([[0.5], [1.0]], dtype=torch.float64)
NOISE = torch.tensor([0.04, 0.25], dtype=torch.float64)
PROBE = torch.tensor([[1.0, -0.5]], dtype=torch.float64)
TOLERANCE = 0.3
START = MultivariateNormal(torch.tensor([1.0, -2.0]).double(), torch.diag(torch.tensor([0.5, 0.8]).double()))


class ProbedGoal(Prior):
    """N(eta; H Z, r), flat along the other direction."""

    def forward(self, task: Any = None) -> GaussianFactor:
        goal = self.own_task(task)
        constant = -0.5 * (goal[..., 0] ** 2 / TOLERANCE + math.log(2 * math.pi * TOLERANCE))
        return GaussianFactor(PROBE.mT @ PROBE / TOLERANCE, goal @ PROBE / TOLERANCE, constant)


def linear_model() -> BJEPA:
    model = make_model(5, 2, action_dim=1)
    with torch.no_grad():
        model.predictor.trunks[0].weight.copy_(torch.cat([DYNAMICS, CONTROL], 1))
        model.predictor.constants[0].copy_(NOISE.log())
    return model


def kalman(goals: Tensor, actions: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Mean, covariance and log evidence after every virtual measurement; the first one corrects the start."""
    mean, covariance, steps = START.mean, START.covariance_matrix, []
    for t, goal in enumerate(goals):
        if t:
            mean = DYNAMICS @ mean + CONTROL @ actions[t - 1]
            covariance = DYNAMICS @ covariance @ DYNAMICS.mT + NOISE.diag()
        spread = PROBE @ covariance @ PROBE.mT + TOLERANCE
        evidence = MultivariateNormal(PROBE @ mean, spread).log_prob(goal)
        gain = covariance @ PROBE.mT / spread
        mean = mean + gain @ (goal - PROBE @ mean)
        covariance = covariance - gain @ PROBE @ covariance
        steps.append((mean, covariance, evidence))
    return steps


GOALS = torch.tensor([[0.5], [2.0], [-1.0], [0.0], [1.0]], dtype=torch.float64)
ACTIONS = torch.tensor([[0.3], [-1.0], [0.5], [1.0], [0.0]], dtype=torch.float64)


def test_eq_bjepa_filter_over_a_gaussian_belief_is_the_kalman_filter() -> None:
    """Predict with the dynamics, correct with the task: the covariance and the evidence too."""
    predictor, prior = linear_model().predictor, ProbedGoal(task_key="goal")
    p = START
    for t, (mean, covariance, evidence) in enumerate(kalman(GOALS, ACTIONS)):
        if t:
            means, covariances = propagate_moments(
                predictor.dist, p.mean, ACTIONS[t - 1 : t], covariance=p.covariance_matrix
            )
            p = full_gaussian(means[0], torch.linalg.cholesky(covariances[0]))
        fusion = fuse(p, prior(GOALS[t]))
        p = fusion.posterior
        torch.testing.assert_close(p.mean, mean, rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(p.covariance_matrix, covariance, rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(fusion.log_evidence, evidence, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("looks_at_the_task", [True, False])
def test_eq_bjepa_filter_with_particles_is_the_kalman_filter(looks_at_the_task: bool) -> None:
    """Tasks are the observations of a particle filter, the fused transition its proposal."""
    constraint = VirtualObservation(ProbedGoal(task_key="goal"))
    bpf = ParticleFilter(
        linear_model(),
        constraint,
        proposal=constraint.condition if looks_at_the_task else None,
        num_particles=20000,
        initial=START,
        generator=torch.Generator().manual_seed(0),
    )
    out = bpf.filter(GOALS, ACTIONS)
    for t, (mean, covariance, evidence) in enumerate(kalman(GOALS, ACTIONS)):
        error = 5 * (covariance.diagonal() / out["effective_sample_size"][t]).sqrt()
        assert ((out["mean"][t] - mean).abs() < error).all()
        torch.testing.assert_close(out["covariance"][t], covariance, rtol=0.1, atol=0.01)
        assert out["log_evidence"][t].item() == pytest.approx(evidence.item(), abs=0.05)


def test_eq_bjepa_filter_weighs_by_the_evidence_of_the_fused_transition() -> None:
    """p(z') p_prior(z') / r(z') with r the fused transition is its evidence, whatever was drawn."""
    model, prior = linear_model(), ProbedGoal(task_key="goal")
    constraint = VirtualObservation(prior)
    bpf = ParticleFilter(
        model,
        constraint,
        proposal=constraint.condition,
        num_particles=50,
        initial=START,
        resample_threshold=0,
    )
    with torch.no_grad():
        before, _ = bpf.start(GOALS[0])
        after, log_evidence = bpf.step(before, ACTIONS[0], GOALS[1])
        fusion = model.fuse(prior).fuse(before.particles, ACTIONS[0].expand(50, 1), task=GOALS[1])
    joint = before.log_weights + fusion.log_evidence
    torch.testing.assert_close(after.log_weights, joint.log_softmax(-1))
    torch.testing.assert_close(log_evidence, joint.logsumexp(-1))


def test_a_filter_reads_tasks_from_tensordicts() -> None:
    constraint = VirtualObservation(ProbedGoal(task_key="goal"))
    bpf = ParticleFilter(linear_model(), constraint, initial=START, observation_key="goal", num_particles=100)
    out = bpf(TensorDict(goal=GOALS, batch_size=5))
    assert out["latent"].shape == (5, 2)
    assert out["next", "belief", "particles"].shape == (5, 100, 2)


# --- the derivation of the appendix (app:poe_derivation)


def test_the_posterior_is_the_product_of_experts_over_the_marginal() -> None:
    """Z_T ~ N(0, V); Z_C and eta see it independently: p(Z | Z_C) p(Z | eta) / p(Z), exactly."""
    eye = torch.eye(2, dtype=torch.float64)
    context, task = torch.tensor([1.0, -2.0]).double(), torch.tensor([0.4]).double()
    noise = torch.tensor([[0.5, 0.2], [0.2, 0.3]], dtype=torch.float64)
    gaps = []
    for width in (1.0, 10.0, 100.0):
        marginal = width * torch.tensor([[2.0, 0.5], [0.5, 1.0]], dtype=torch.float64)
        # The joint of both observations, conditioned at once: the posterior without any factorisation.
        sensor = torch.cat([eye, PROBE])
        spread = sensor @ marginal @ sensor.mT + torch.block_diag(noise, torch.full((1, 1), TOLERANCE))
        gain = marginal @ sensor.mT @ torch.linalg.inv(spread)
        mean, covariance = gain @ torch.cat([context, task]), marginal - gain @ sensor @ marginal
        experts = []
        for matrix, error, value in ((eye, noise, context), (PROBE, TOLERANCE * torch.eye(1), task)):
            k = marginal @ matrix.mT @ torch.linalg.inv(matrix @ marginal @ matrix.mT + error)
            experts.append(MultivariateNormal(k @ value, marginal - k @ matrix @ marginal))
        inverse = GaussianFactor(-torch.linalg.inv(marginal), torch.zeros(2, dtype=torch.float64))
        exact = product_of_experts(*experts, inverse)
        torch.testing.assert_close(exact.mean, mean)
        torch.testing.assert_close(exact.covariance_matrix, covariance)
        # The marginal taken as uniform, as BJEPA does: wrong by O(1 / V).
        gaps.append((product_of_experts(*experts).mean - mean).abs().max().item())
    assert gaps[0] > 0.02
    assert gaps[2] == pytest.approx(gaps[1] / 10, rel=0.2)


# --- thm:bjepa_map_optimal: more of it, in one dimension, by numerical integration

TICKS = torch.linspace(-15.0, 15.0, 30001, dtype=torch.float64)
PLANS = torch.linspace(-3.0, 3.0, 241, dtype=torch.float64)


def planned(prior: Any, noise: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Costs of the actions: at the latent MAP, expected (by integration), and expected by ``fuse``."""

    def cost(z: Tensor, u: Tensor) -> Tensor:
        return 2.0 * (z - 1.2).square() + 0.3 * u.square()

    p = diag_gaussian((0.8 + 0.7 * PLANS).unsqueeze(-1), noise(PLANS).unsqueeze(-1))
    point, _ = map_estimate(p, prior, num_restarts=24, generator=torch.Generator().manual_seed(0))
    z = TICKS.reshape(-1, 1, 1)
    weights = (p.log_prob(z) + prior.log_prob(z)).softmax(0)
    expected = (weights * cost(TICKS.unsqueeze(-1), PLANS)).sum(0)
    # The same noise for all actions, which are rows of one sample: their order does not depend on luck.
    generator = torch.Generator().manual_seed(1)
    rows = fuse(p.expand((1, len(PLANS))), prior, num_particles=8000, generator=generator, shared_noise=True)
    posterior = rows.posterior
    # Of a quadratic cost: the cost of the mean, and the variance.
    sampled = cost(posterior.mean[0, :, 0], PLANS) + 2.0 * posterior.variance[0, :, 0]
    return cost(point.squeeze(-1), PLANS), expected, sampled


def constant_noise(u: Tensor) -> Tensor:
    return torch.full_like(u, 0.6)


def test_thm_bjepa_map_optimal_by_integration() -> None:
    """All assumptions hold: the best action for the MAP is the best one, the costs differ by a constant."""
    prior = diag_gaussian(torch.tensor([-0.5]).double(), torch.tensor([0.9]).double())
    at_map, expected, sampled = planned(prior, constant_noise)
    assert at_map.argmin() == expected.argmin()
    variance = 1 / (1 / 0.6**2 + 1 / 0.9**2)
    torch.testing.assert_close(expected - at_map, torch.full_like(PLANS, 2.0 * variance))
    torch.testing.assert_close(sampled, expected)


@pytest.mark.parametrize("broken", ["the noise depends on the action", "the prior is not Gaussian"])
def test_thm_bjepa_map_optimal_needs_its_assumptions(broken: str) -> None:
    """The best action for the MAP costs more than the best one; the fused posterior still finds that."""
    prior: Any = diag_gaussian(torch.tensor([-0.5]).double(), torch.tensor([3.0]).double())
    noise = constant_noise
    if broken == "the prior is not Gaussian":
        # Steep to the left, slowly falling to the right: the mean is far from the mode.
        prior = Density(
            lambda z: torch.where(z[..., 0] < 0.5, 8.0 * (0.5 - z[..., 0]), 0.1 * (z[..., 0] - 0.5))
        )
    else:

        def noise(u: Tensor) -> Tensor:
            return 0.2 + 0.8 * u.abs()

    at_map, expected, sampled = planned(prior, noise)
    best = expected.argmin()
    assert (PLANS[at_map.argmin()] - PLANS[best]).abs() > 0.1
    assert expected[at_map.argmin()] > expected[best] + 0.1
    assert expected[sampled.argmin()] < expected[best] + 0.005


def test_hard_fusion_lies_between_its_experts_and_is_sharper_than_both() -> None:
    model = make_model(6, 3)
    with torch.no_grad():
        model.predictor.constants.normal_()
    latent = torch.randn(50, 3, dtype=torch.float64)
    prior = GaussianPrior(3, mean=1.5, std=torch.tensor([0.2, 1.0, 4.0])).double()
    likelihood, post = model.predictor.dist(latent), model.fuse(prior).dist(latent)
    low, high = torch.minimum(likelihood.mean, prior.mean), torch.maximum(likelihood.mean, prior.mean)
    assert ((post.mean > low) & (post.mean < high)).all()
    assert (post.variance < torch.minimum(likelihood.variance, prior().variance)).all()


# --- nuisance variables


def nuisance(num: int) -> tuple[TensorDict, Tensor]:
    """x = (signal, two unpredictable noises of variances 9 and 4); the signal has variance 1."""
    a, samples = 0.9, exact_normal(num, 6)
    following = a * samples[:, :1] + math.sqrt(1 - a**2) * samples[:, 1:2]
    scale = torch.tensor([3.0, 2.0], dtype=torch.float64)
    first = torch.cat([samples[:, :1], samples[:, 2:4] * scale], 1)
    return pairs(first, torch.cat([following, samples[:, 4:] * scale], 1)), samples


def test_joint_embedding_discards_the_noise() -> None:
    """The structural prior leaves nuisance invariance as it is."""
    windows, _ = nuisance(300)
    model = make_model(3, 1)
    with torch.no_grad():
        model.encoder.module.network.weight.copy_(torch.tensor([[0.2, 0.2, -0.2]]))
    loss = BJEPALoss(
        model,
        structural_kl_coeff=0.1,
        residual_variance="batch",
        marginal_entropy_coeff=1.0,
        target_kl_coeff=0.0,
        collapse_rank=0.0,
    )
    minimise(loss, windows, 250, 0.05)
    weight = model.encoder.module.network.weight.detach()[0].abs()
    assert weight[1:].max() < 0.02 * weight[0]


@pytest.mark.parametrize("start", ["signal", "random"])
def test_reconstruction_keeps_the_noise(start: str) -> None:
    """prop:nuisance_invariance. The optimal linear VAE: all weight on the noise that varies most.

    Also from the encoder that a joint-embedding model would find: it is a saddle, not a minimum.
    """
    windows, _ = nuisance(300)
    model = VAE(3, 1).double()
    if start == "signal":
        with torch.no_grad():
            model.encoder.module.weight.zero_()
            model.encoder.module.weight[0, 0] = 1.0
            model.decoder.module.weight.copy_(torch.tensor([[0.5], [0.0], [0.0]]))
    minimise(VAELoss(model), windows, 300, 0.06)
    for weight in (model.encoder.module.weight[0], model.decoder.module.weight[:, 0]):
        weight = weight.detach().abs()
        assert weight[0] < 0.1 * weight[1]
        assert weight[2] < 0.2 * weight[1]


def test_the_signal_only_vae_is_worse_than_the_noise_only_one() -> None:
    """sqrt(2 beta v) - beta / 2 + the variance of what is left out: the least for the largest v."""
    windows, _ = nuisance(2000)
    values = {}
    variances = (1.0, 9.0, 4.0)
    for kept, v in enumerate(variances):
        model = VAE(3, 1).double()
        encoder = math.sqrt((math.sqrt(2 * v) - 1) / v)
        with torch.no_grad():
            model.encoder.module.weight.zero_()
            model.decoder.module.weight.zero_()
            model.encoder.module.weight[0, kept] = encoder
            model.decoder.module.weight[kept, 0] = encoder * v / (1 + encoder**2 * v)
        values[kept] = sum(VAELoss(model)(windows).values()).item()
        left = sum(variances) - v
        assert values[kept] == pytest.approx(math.sqrt(2 * v) - 0.5 + left, rel=0.03)
    assert values[1] < values[2] < values[0]
