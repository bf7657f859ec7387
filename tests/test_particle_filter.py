"""The particle filter against Kalman filters, a grid filter and a filter written as loops; faults."""

from __future__ import annotations

import copy
import math
import pickle
import warnings
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Distribution, Independent, MultivariateNormal, Normal, StudentT

from torchrl_vjepa.belief import (
    LinearObservation,
    ParticleBelief,
    ParticleFilter,
    PseudoLikelihood,
    systematic_resampling,
)
from torchrl_vjepa.distributions import Delta, diag_gaussian, product_of_experts
from torchrl_vjepa.encoders import linear_encoder
from torchrl_vjepa.heads import TargetScale
from torchrl_vjepa.models import VJEPA
from torchrl_vjepa.noisy_tv import KalmanFilter, LinearGaussianSystem
from torchrl_vjepa.predictor import Predictor
from torchrl_vjepa.priors import GaussianPrior


class KalmanSystem:
    """A small noisy TV with a blunt sensor: signal 2, distractor 1, observation 3."""

    def __init__(self, sensor_std: float = 0.6, noise_scale: float = 2.0) -> None:
        self.system = LinearGaussianSystem(2, 1, 3, 1, sensor_std=sensor_std, signal_std=0.3, seed=5)
        self.kalman = KalmanFilter(self.system, noise_scale)
        self.noise_scale = noise_scale
        self.std = self.kalman.process_covariance.diagonal().sqrt()
        self.sensor = LinearObservation(self.kalman.H, sensor_std)

    def transition(self, latent: Tensor, action: Tensor) -> Distribution:
        return diag_gaussian(latent @ self.kalman.F.mT + action @ self.kalman.G.mT, self.std)

    def simulate(self, rows: int, steps: int) -> Any:
        generator = torch.Generator().manual_seed(11)
        actions = torch.randn(rows, steps, 1, generator=generator, dtype=torch.float64)
        return self.system.simulate(
            steps, self.noise_scale, actions, batch_size=(rows,), seed=7, dtype=torch.float64
        )

    def make_filter(self, seed: int = 0, **kwargs: Any) -> ParticleFilter:
        return ParticleFilter(
            self.transition,
            self.sensor,
            latent_dim=3,
            action_dim=1,
            dtype=torch.float64,
            generator=torch.Generator().manual_seed(seed),
            **kwargs,
        )


@pytest.fixture(scope="module")
def problem() -> KalmanSystem:
    return KalmanSystem()


def test_mean_and_evidence_are_those_of_the_kalman_filter(problem: KalmanSystem) -> None:
    """Within 5 % of the Kalman filter's squared error, evidence within its standard error; K = 1000."""
    rows, steps, repeats = 50, 30, 5
    data = problem.simulate(rows, steps)
    exact = problem.kalman.filter(data["observation"], data["action"])
    observations, actions = (data[key].expand(repeats, -1, -1, -1) for key in ("observation", "action"))
    run = problem.make_filter(num_particles=1000).filter(observations, actions)
    state = torch.cat([data["signal"], data["distractor"]], -1)
    kalman_mean = torch.cat([exact["signal_mean"], exact["distractor_mean"]], -1)
    kalman_error = (kalman_mean - state).square().mean()
    errors = (run["mean"] - state).square().mean((-1, -2, -3))
    assert (errors < 1.05 * kalman_error).all()
    evidence = run["log_evidence"].sum(-1)
    error = evidence.std(0)
    assert ((evidence - exact["log_evidence"].sum(-1)).abs() < 4 * error).all()
    # E log Z = log E Z - Var / 2 for a log-normal Z
    bias = (evidence.mean(0) + 0.5 * error**2 - exact["log_evidence"].sum(-1)).mean()
    assert bias.abs() < 4 * error.square().mean().sqrt() / (rows * repeats) ** 0.5
    for t in (0, 10, steps - 1):
        expected = problem.kalman.filtered_covariance[min(t, len(problem.kalman.gain) - 1)]
        covariance = run["covariance"][:, :, t].mean((0, 1))
        torch.testing.assert_close(covariance, expected, atol=0.03 * float(expected.max()), rtol=0.03)


def test_evidence_is_unbiased(problem: KalmanSystem) -> None:
    """E exp(log evidence) is p(x_{0:T}), with few particles too, however it is resampled."""
    data = problem.simulate(1, 4)
    exact = problem.kalman.filter(data["observation"], data["action"])["log_evidence"].sum()
    rows = 8_000
    observations, actions = (data[key].expand(rows, -1, -1) for key in ("observation", "action"))
    for threshold in (0.0, 0.6):
        run = problem.make_filter(1, num_particles=30, resample_threshold=threshold)
        ratio = (run.filter(observations, actions)["log_evidence"].sum(-1) - exact).exp()
        assert (ratio.mean() - 1).abs() < 4 * ratio.std() / rows**0.5, threshold


def test_a_proposal_that_looks_at_the_observation() -> None:
    """A sensor so sharp that the bootstrap filter would need many thousand particles."""
    problem = KalmanSystem(sensor_std=0.01)
    data = problem.simulate(10, 20)
    exact = problem.kalman.filter(data["observation"], data["action"])
    run = problem.make_filter(num_particles=1000, proposal=problem.sensor.condition)
    out = run.filter(data["observation"], data["action"])
    error = (exact["signal_mean"] - data["signal"]).square().mean()
    assert (out["mean"][..., :2] - data["signal"]).square().mean() < 1.05 * error
    assert out["effective_sample_size"].min() > 500
    difference = out["log_evidence"].sum(-1) - exact["log_evidence"].sum(-1)
    assert difference.abs().mean() < 0.2
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        blind = problem.make_filter(num_particles=1000).filter(data["observation"], data["action"])
    assert blind["effective_sample_size"].median() < 20


def test_linear_observation_is_a_kalman_update() -> None:
    torch.manual_seed(0)
    matrix, std = torch.randn(5, 3).double(), torch.rand(5).double() + 0.1
    sensor = LinearObservation(matrix, std)
    observation, latent = torch.randn(2, 1, 5).double(), torch.randn(2, 7, 3).double()
    expected = Independent(Normal(latent @ matrix.mT, std), 1).log_prob(observation)
    torch.testing.assert_close(sensor(observation, latent), expected)
    factor = torch.randn(2, 7, 3, 3).double()
    prior = MultivariateNormal(latent, factor @ factor.mT + torch.eye(3).double())
    gain = prior.covariance_matrix @ matrix.mT
    gain = gain @ torch.linalg.inv(matrix @ gain + torch.diag(std**2))
    mean = latent + (gain @ (observation - latent @ matrix.mT).unsqueeze(-1)).squeeze(-1)
    covariance = prior.covariance_matrix - gain @ matrix @ prior.covariance_matrix
    posterior = sensor.condition(prior, observation)
    torch.testing.assert_close(posterior.mean, mean)
    torch.testing.assert_close(posterior.covariance_matrix, covariance)
    # Bayes: prior times likelihood over posterior is the same wherever it is evaluated.
    evidence = [
        prior.log_prob(z) + sensor(observation, z) - posterior.log_prob(z)
        for z in (latent, torch.zeros_like(latent))
    ]
    torch.testing.assert_close(*evidence)


@pytest.mark.parametrize(
    ("matrix", "std", "message"),
    [
        (torch.zeros(3), 1.0, "matrix must be finite with shape"),
        (torch.full((3, 2), math.nan), 1.0, "matrix must be finite"),
        (torch.zeros(3, 2), 0.0, "std must be positive"),
        (torch.zeros(3, 2), torch.ones(2), r"a number or of shape \(3,\)"),
        (torch.zeros(3, 2), math.inf, "std must be positive"),
    ],
)
def test_bad_sensors_are_refused(matrix: Tensor, std: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LinearObservation(matrix, std)


@pytest.mark.parametrize("noise_scale", [0.0, 4.0, 8.0])
def test_the_paper_s_noisy_tv_with_a_thousand_particles(noise_scale: float) -> None:
    system = LinearGaussianSystem(control_dim=2, seed=1)
    kalman = KalmanFilter(system, noise_scale)
    std = kalman.process_covariance.diagonal().sqrt()
    sensor = LinearObservation(kalman.H, system.sensor_std)
    run = ParticleFilter(
        lambda z, u: diag_gaussian(z @ kalman.F.mT + u @ kalman.G.mT, std),
        sensor,
        proposal=sensor.condition,
        num_particles=1000,
        latent_dim=8,
        action_dim=2,
        dtype=torch.float64,
        generator=torch.Generator().manual_seed(0),
    )
    data = system.simulate(12, noise_scale, torch.randn(12, 2), batch_size=(6,), seed=3, dtype=torch.float64)
    exact = kalman.filter(data["observation"], data["action"])
    out = run.filter(data["observation"], data["action"])
    error = (exact["signal_mean"] - data["signal"]).square().mean()
    assert (out["mean"][..., :4] - data["signal"]).square().mean() < 1.05 * error
    difference = out["log_evidence"].sum(-1) - exact["log_evidence"].sum(-1)
    assert difference.abs().max() < 0.5


def test_nonlinear_filter_against_a_grid() -> None:
    """z' = 0.8 z + 2 sin z + u + w, x = z^2 / 5 + Student noise: two modes; by sums over a grid."""
    grid = torch.linspace(-8, 8, 1601, dtype=torch.float64)

    def transition(latent: Tensor, action: Tensor) -> Distribution:
        return diag_gaussian(0.8 * latent + 2 * latent.sin() + action, torch.full_like(latent[:1], 0.5))

    def likelihood(observation: Tensor, latent: Tensor) -> Tensor:
        return StudentT(4.0, latent.square() / 5, 0.3).log_prob(observation).sum(-1)

    steps, rows, repeats = 6, 3, 16
    observations = torch.tensor([[0.4, 1.0, 1.6, 1.2, 2.0, 1.4]], dtype=torch.float64)
    observations = (observations + torch.tensor([[0.0], [0.2], [-0.3]])).unsqueeze(-1)
    actions = torch.linspace(-0.5, 0.5, steps, dtype=torch.float64).expand(rows, steps).unsqueeze(-1)

    kernel_means = (0.8 * grid + 2 * grid.sin()).unsqueeze(-1)
    weights = Normal(0.0, 1.0).log_prob(grid).exp().expand(rows, -1) * (grid[1] - grid[0])
    means, variances, evidences = [], [], []
    for t in range(steps):
        if t:
            kernel = Normal(kernel_means + actions[0, t - 1], 0.5).log_prob(grid).exp()
            weights = weights @ (kernel * (grid[1] - grid[0]))
        x = observations[:, t].unsqueeze(-2)
        weights = weights * likelihood(x, grid.unsqueeze(-1)).exp()
        total = weights.sum(-1)
        evidences.append(total.log())
        weights = weights / total.unsqueeze(-1)
        means.append(weights @ grid)
        variances.append(weights @ grid.square() - means[-1] ** 2)

    run = ParticleFilter(
        transition,
        likelihood,
        num_particles=4000,
        latent_dim=1,
        action_dim=1,
        dtype=torch.float64,
        generator=torch.Generator().manual_seed(0),
    )
    out = run.filter(observations.expand(repeats, -1, -1, -1), actions.expand(repeats, -1, -1, -1))
    for values, exact in (
        (out["mean"].squeeze(-1), means),
        (out["covariance"].flatten(2), variances),
        (out["log_evidence"], evidences),
    ):
        error = values.std(0) / repeats**0.5
        assert (error < 0.1).all()
        assert ((values.mean(0) - torch.stack(exact, 1)).abs() < 5 * error).all()
    assert max(variances[-1]) > 1.0  # two modes


# --- option B


def measured(observation: Tensor) -> Distribution:
    """q(z | x): an encoder that sees the state with a standard deviation of 0.4."""
    return diag_gaussian(0.5 * observation, torch.full_like(observation[..., :1], 0.4))


def walk(latent: Tensor, action: Tensor) -> Distribution:
    return diag_gaussian(0.9 * latent + action, torch.full_like(latent[..., :1], 0.5))


@pytest.mark.parametrize("reference", [None, GaussianPrior(2, std=2.0)])
def test_pseudo_likelihood_is_the_ratio(reference: Any) -> None:
    likelihood = PseudoLikelihood(measured, reference)
    observation, latent = torch.randn(4, 2), torch.randn(4, 7, 2)
    std = 1.0 if reference is None else 2.0
    value = likelihood(observation.unsqueeze(1), latent)
    for row in range(4):
        q = Independent(Normal(0.5 * observation[row], 0.4), 1)
        p = Independent(Normal(torch.zeros(2), std), 1)
        torch.testing.assert_close(value[row], q.log_prob(latent[row]) - p.log_prob(latent[row]))


def test_the_target_of_a_vjepa() -> None:
    """q_theta'(z | x) around its own encoding, with a scale that depends on the observation."""
    scale = TargetScale(4, 20, kind="linear")
    model = VJEPA(linear_encoder(20, 4), Predictor(4, action_dim=2), target_scale=scale)

    def target(observation: Tensor) -> Distribution:
        return model.target_dist(model.encoder.module(observation), observation)

    run = ParticleFilter(
        model,
        PseudoLikelihood(target),
        num_particles=4000,
        proposal=lambda p, x: target(x).expand(p.batch_shape),
        generator=torch.Generator().manual_seed(0),
    )
    observations = torch.randn(3, 5, 20)
    with torch.no_grad():
        first = run.filter(observations[:, :1], torch.zeros(3, 1, 2))
        q = target(observations[:, 0])
    # The initial prior is the reference: the first belief is q itself, with equal weights.
    torch.testing.assert_close(first["effective_sample_size"], torch.full((3, 1), 4000.0))
    assert ((first["mean"][:, 0] - q.mean).abs() < 5 * q.stddev / 4000**0.5).all()
    with torch.no_grad():
        assert run.filter(observations, torch.randn(3, 5, 2))["mean"].isfinite().all()


@pytest.mark.parametrize("proposal", [None, lambda p, x: product_of_experts(p, measured(x))])
def test_option_b_is_the_product_of_the_gaussians(proposal: Any) -> None:
    """N(prediction) times q / p_ref, in closed form."""
    run = ParticleFilter(
        walk,
        PseudoLikelihood(measured, GaussianPrior(2, std=2.0)),
        num_particles=40_000,
        initial=GaussianPrior(2, std=2.0),
        proposal=proposal,
        latent_dim=2,
        action_dim=2,
        generator=torch.Generator().manual_seed(0),
    )
    first, second = torch.tensor([[1.0, -0.5], [0.2, 0.6]])
    action = torch.tensor([0.3, -0.3])
    belief, log_evidence = run.start(first)
    # The initial prior is the reference: the belief is q, and the evidence of any observation is 1.
    torch.testing.assert_close(belief.mean, 0.5 * first, atol=0.01, rtol=0)
    torch.testing.assert_close(belief.variance, torch.full((2,), 0.16), atol=0.01, rtol=0)
    assert abs(log_evidence) < 0.1
    belief, log_evidence = run.step(belief, action, second)
    prior_mean, prior_var = 0.45 * first + action, 0.81 * 0.16 + 0.25
    precision = 1 / prior_var + 1 / 0.16 - 1 / 4.0
    mean = (prior_mean / prior_var + 0.5 * second / 0.16) / precision
    torch.testing.assert_close(belief.mean, mean, atol=0.01, rtol=0)
    torch.testing.assert_close(belief.variance, torch.full((2,), 1 / precision), atol=0.01, rtol=0)
    grid = torch.linspace(-8, 8, 4001)
    ratio = (
        Normal(prior_mean.unsqueeze(-1), prior_var**0.5).log_prob(grid)
        + Normal(0.5 * second.unsqueeze(-1), 0.4).log_prob(grid)
        - Normal(0.0, 2.0).log_prob(grid)
    )
    expected = (ratio.exp().sum(-1) * (grid[1] - grid[0])).log().sum()
    assert log_evidence.item() == pytest.approx(float(expected), abs=0.1)
    ess = run.start(first)[0].effective_sample_size
    assert (ess > 39_000) == (proposal is not None)


# --- the algorithm


def loop_filter(
    particles: Tensor, log_weights: Tensor, noise: Tensor, likelihood: Tensor
) -> tuple[list[float], float]:
    """One step of weighting written as a loop over particles of one row."""
    moved = [0.5 * float(particles[k]) + float(noise[k]) for k in range(len(particles))]
    products = [math.exp(float(log_weights[k])) * math.exp(float(likelihood[k])) for k in range(len(moved))]
    total = sum(products)
    return [product / total for product in products], math.log(total)


def test_one_step_equals_a_loop() -> None:
    """Weights multiply, and are not thrown away where nothing is resampled."""
    noise = torch.randn(2, 5)

    def transition(latent: Tensor, action: Tensor) -> Delta:
        return Delta(0.5 * latent + noise.unsqueeze(-1))

    def likelihood(observation: Tensor, latent: Tensor) -> Tensor:
        return -(observation - latent).square().sum(-1)

    run = ParticleFilter(
        transition, likelihood, num_particles=5, latent_dim=1, action_dim=0, resample_threshold=0.0
    )
    before = ParticleBelief(torch.randn(2, 5, 1), torch.randn(2, 5))
    observation = torch.randn(2, 1)
    after, log_evidence = run.step(before, torch.empty(2, 0), observation)
    for row in range(2):
        moved = 0.5 * before.particles[row, :, 0] + noise[row]
        torch.testing.assert_close(after.particles[row, :, 0], moved)
        weights, evidence = loop_filter(
            before.particles[row, :, 0],
            before.log_weights[row],
            noise[row],
            -(observation[row] - moved).square(),
        )
        torch.testing.assert_close(after.weights[row], torch.tensor(weights))
        assert log_evidence[row].item() == pytest.approx(evidence, abs=1e-5)


def test_rows_resample_by_themselves() -> None:
    """Only where the effective sample size is below the threshold; then all weights are equal."""
    run = ParticleFilter(
        lambda z, u: Delta(z),
        lambda x, z: torch.zeros(z.shape[:-1]),
        num_particles=8,
        latent_dim=1,
        action_dim=0,
        resample_threshold=0.5,
    )
    particles = torch.arange(8.0).unsqueeze(-1).expand(3, 8, 1)
    log_weights = torch.full((3, 8), -math.inf)
    log_weights[0, :5] = 0  # worth 5 of 8
    log_weights[1, :3] = 0  # worth 3 of 8
    log_weights[2, 6] = 0
    after, _ = run.step(ParticleBelief(particles, log_weights), torch.empty(3, 0), torch.zeros(3, 1))
    assert torch.equal(after.particles[0], particles[0])
    torch.testing.assert_close(after.weights[0, :5], torch.full((5,), 0.2))
    assert set(after.particles[1].flatten().tolist()) == {0.0, 1.0, 2.0}
    torch.testing.assert_close(after.weights[1:], torch.full((2, 8), 0.125))
    assert (after.particles[2] == 6).all()


def test_rows_do_not_see_each_other(problem: KalmanSystem) -> None:
    data = problem.simulate(4, 6)
    out = problem.make_filter(num_particles=50).filter(data["observation"], data["action"])
    changed = data["observation"].clone()
    changed[1] += 1.0
    other = problem.make_filter(num_particles=50).filter(changed, data["action"])
    for key in ("mean", "log_evidence"):
        for row in (0, 2, 3):
            assert torch.equal(out[key][row], other[key][row])
        assert not torch.equal(out[key][1], other[key][1])


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("chunk_size", [None, 3, 10])
def test_batches_and_chunks(problem: KalmanSystem, batch: tuple[int, ...], chunk_size: int | None) -> None:
    seen: list[torch.Size] = []

    def transition(latent: Tensor, action: Tensor) -> Distribution:
        seen.append(latent.shape)
        assert action.shape == (*latent.shape[:-1], 1)
        return problem.transition(latent, action)

    run = problem.make_filter(num_particles=10, chunk_size=chunk_size)
    run.transition = transition
    observations, actions = torch.randn(*batch, 4, 3).double(), torch.randn(*batch, 4, 1).double()
    out = run.filter(observations, actions)
    assert out.batch_size == (*batch, 4)
    assert out["mean"].shape == (*batch, 4, 3)
    assert out["covariance"].shape == (*batch, 4, 3, 3)
    sizes = {None: [10], 3: [3, 3, 3, 1], 10: [10]}[chunk_size]
    assert seen == [(*batch, size, 3) for size in sizes * 3]


def test_chunks_give_the_same_belief(problem: KalmanSystem) -> None:
    data = problem.simulate(20, 10)
    exact = problem.kalman.filter(data["observation"], data["action"])["signal_mean"]
    out = problem.make_filter(num_particles=1000, chunk_size=64).filter(data["observation"], data["action"])
    whole = problem.make_filter(num_particles=1000).filter(data["observation"], data["action"])
    errors = [(run["mean"][..., :2] - exact).square().mean() for run in (out, whole)]
    assert errors[0] < 1.5 * errors[1]


def test_images_and_modules() -> None:
    """Observations of three dimensions; parameters of the parts belong to the filter."""

    class Decoder(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.readout = nn.Linear(4, 3 * 2 * 2)

        def forward(self, observation: Tensor, latent: Tensor) -> Tensor:
            image = self.readout(latent).unflatten(-1, (3, 2, 2))
            assert observation.shape[-4:] == (1, 3, 2, 2)
            return Independent(Normal(image, 1.0), 3).log_prob(observation)

    run = ParticleFilter(
        Predictor(4, action_dim=2), Decoder(), num_particles=9, observation_ndim=3, initial=GaussianPrior(4)
    )
    names = {name.split(".")[0] for name, _ in run.named_parameters()}
    assert names == {"predictor", "likelihood"}
    out = run.filter(torch.randn(5, 7, 3, 2, 2), torch.randn(5, 7, 2))
    assert out["mean"].shape == (5, 7, 4)
    out = run.double().filter(torch.randn(5, 7, 3, 2, 2).double(), torch.randn(5, 7, 2).double())
    assert out["mean"].dtype == torch.float64
    assert run.make_tensordict_primer().primers["belief", "particles"].dtype == torch.float64


def test_randomness_is_the_generators(problem: KalmanSystem) -> None:
    data = problem.simulate(2, 5)
    arguments = data["observation"], data["action"]
    state = torch.get_rng_state()
    run = problem.make_filter(num_particles=20, proposal=problem.sensor.condition)
    twin = copy.deepcopy(run)
    first = run.filter(*arguments)["mean"]
    assert torch.equal(first, twin.filter(*arguments)["mean"])
    assert not torch.equal(first, run.filter(*arguments)["mean"])
    assert torch.equal(torch.get_rng_state(), state)


def test_a_filter_pickles() -> None:
    run = ParticleFilter(
        Predictor(2, action_dim=2),
        PseudoLikelihood(measured),
        num_particles=6,
        generator=torch.Generator().manual_seed(4),
    )
    again = pickle.loads(pickle.dumps(run))
    arguments = torch.randn(2, 3, 2), torch.randn(2, 3, 2)
    assert torch.equal(run.filter(*arguments)["mean"], again.filter(*arguments)["mean"])


# --- faults


def faulty(values: Tensor) -> ParticleFilter:
    """Three particles at 0, 1, 2 that do not move, with the given log-likelihoods."""
    return ParticleFilter(
        lambda z, u: Delta(z),
        lambda x, z: values.expand(z.shape[:-1]),
        num_particles=3,
        latent_dim=1,
        action_dim=0,
        resample_threshold=0.0,
    )


BEFORE = ParticleBelief(
    torch.arange(3.0).unsqueeze(-1).expand(2, 3, 1), torch.tensor([0.2, 0.3, 0.5]).log().expand(2, 3)
)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_bad_likelihood_counts_as_zero_with_a_warning(bad: float) -> None:
    values = torch.tensor([[0.0, bad, 0.0], [0.0, 0.0, 0.0]])
    with pytest.warns(RuntimeWarning, match="0 of 2 beliefs .* nan or inf"):
        belief, log_evidence = faulty(values).step(BEFORE, torch.empty(2, 0), torch.zeros(2, 1))
    torch.testing.assert_close(belief.weights, torch.tensor([[2 / 7, 0, 5 / 7], [0.2, 0.3, 0.5]]))
    torch.testing.assert_close(log_evidence, torch.tensor([0.7, 1.0]).log())


@pytest.mark.parametrize("bad", [-math.inf, math.nan])
def test_an_impossible_observation_is_ignored_with_a_warning(bad: float) -> None:
    values = torch.tensor([[bad, bad, bad], [0.0, -1.0, 0.0]])
    with pytest.warns(RuntimeWarning, match="the weights of 1 of 2 beliefs are all zero"):
        belief, log_evidence = faulty(values).step(BEFORE, torch.empty(2, 0), torch.zeros(2, 1))
    torch.testing.assert_close(belief.weights[0], BEFORE.weights[0])
    assert log_evidence[0] == -math.inf
    assert log_evidence[1].isfinite()
    assert belief.mean.isfinite().all()


def test_some_weights_may_be_zero_without_a_warning() -> None:
    values = torch.tensor([[-math.inf, 0.0, -math.inf], [0.0, 0.0, 0.0]])
    belief, _ = faulty(values).step(BEFORE, torch.empty(2, 0), torch.zeros(2, 1))
    torch.testing.assert_close(belief.weights[0], torch.tensor([0.0, 1.0, 0.0]))


def test_far_observations_are_weighed_in_log_space() -> None:
    values = torch.tensor([-1e4, -1e4 - 1.0, -2e4])
    belief, log_evidence = faulty(values).step(BEFORE, torch.empty(2, 0), torch.zeros(2, 1))
    ratio = 0.2 / (0.3 * math.exp(-1))
    torch.testing.assert_close(
        belief.weights[:, 0] / belief.weights[:, 1], torch.full((2,), ratio), rtol=1e-3, atol=0
    )
    assert (log_evidence < -9999).all()


def test_predictions_that_are_not_finite_are_refused() -> None:
    run = ParticleFilter(
        lambda z, u: Delta(z * math.nan), lambda x, z: z.sum(-1), num_particles=3, latent_dim=1, action_dim=0
    )
    with pytest.raises(ValueError, match="model must predict finite latents"):
        run.step(BEFORE, torch.empty(2, 0), torch.zeros(2, 1))


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"num_particles": 0}, ValueError, "num_particles must be an integer of at least 1, got 0"),
        ({"num_particles": 2.0}, ValueError, "num_particles must be an integer"),
        ({"chunk_size": 0}, ValueError, "chunk_size must be an integer of at least 1, got 0"),
        ({"latent_dim": None}, ValueError, "latent_dim must be an integer of at least 1, got None"),
        ({"action_dim": None}, ValueError, "action_dim must be an integer of at least 0, got None"),
        ({"observation_ndim": -1}, ValueError, "observation_ndim must be an integer of at least 0"),
        ({"resample_threshold": 1.1}, ValueError, r"resample_threshold must be in \[0, 1\], got 1.1"),
        ({"resample_threshold": math.nan}, ValueError, "resample_threshold must be in"),
        ({"model": 3}, TypeError, "model must be callable, got int"),
        ({"likelihood": None}, TypeError, "likelihood must be callable, got NoneType"),
    ],
)
def test_bad_arguments_are_refused(kwargs: dict[str, Any], error: type[Exception], message: str) -> None:
    arguments: dict[str, Any] = {
        "model": walk,
        "likelihood": PseudoLikelihood(measured),
        "latent_dim": 2,
        "action_dim": 2,
        **kwargs,
    }
    with pytest.raises(error, match=message):
        ParticleFilter(**arguments)


def test_bad_shapes_are_refused() -> None:
    run = ParticleFilter(walk, PseudoLikelihood(measured), num_particles=4, latent_dim=2, action_dim=2)
    belief = ParticleBelief(torch.zeros(3, 4, 2))
    with pytest.raises(ValueError, match=r"action must have shape \(3, 2\), got \(3, 1\)"):
        run.step(belief, torch.zeros(3, 1), torch.zeros(3, 2))
    with pytest.raises(ValueError, match=r"particles of shape \(5, 4, 2\).*got \(3, 4, 2\)"):
        run.step(belief, torch.zeros(5, 2), torch.zeros(5, 2))
    with pytest.raises(ValueError, match="observation must have 1 dimensions"):
        run.start(torch.tensor(1.0))
    for observations in (torch.zeros(2), torch.zeros(3, 0, 2)):
        with pytest.raises(ValueError, match=r"observations must have shape \(\*B, T, \*O\)"):
            run.filter(observations, torch.zeros(3, 0, 2))
    with pytest.raises(ValueError, match=r"actions must have shape \(3, 5, 2\), got \(3, 4, 2\)"):
        run.filter(torch.zeros(3, 5, 2), torch.zeros(3, 4, 2))
    with pytest.raises(ValueError, match=r"likelihood must give values of shape \(3, 4\), got \(4,\)"):
        ParticleFilter(walk, lambda x, z: torch.zeros(4), num_particles=4, latent_dim=2, action_dim=2).start(
            torch.zeros(3, 2)
        )
    run.initial = diag_gaussian(torch.zeros(5), torch.ones(5))
    with pytest.raises(
        ValueError, match=r"initial must have no batch and event shape \(2,\), got \(\) and \(5,\)"
    ):
        run.start(torch.zeros(3, 2))
    run.initial, run.proposal = None, lambda p, x: diag_gaussian(x, torch.ones(1))
    with pytest.raises(ValueError, match=r"proposal must give draws of shape \(3, 4, 2\), got \(3, 1, 2\)"):
        run.start(torch.zeros(3, 2))


@pytest.mark.parametrize("threshold", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("bad", [math.nan, -math.inf])
def test_weights_that_were_lost_count_the_same_again(bad: float, threshold: float) -> None:
    """A belief that comes without weight in a row is not taken for its last particle."""
    predictor = Predictor(1, action_dim=1)
    run = ParticleFilter(
        predictor,
        lambda observation, latent: -(observation - latent).square().sum(-1),
        num_particles=4,
        resample_threshold=threshold,
        generator=torch.Generator().manual_seed(0),
    )
    particles = torch.arange(8.0).reshape(2, 4, 1)
    weights = torch.stack([torch.full((4,), bad), torch.zeros(4)])
    with pytest.warns(RuntimeWarning, match="weights that 1 of 2 beliefs came with"):
        moved, evidence = run.step(
            ParticleBelief(particles, weights, validate_args=False), torch.zeros(2, 1), torch.zeros(2, 1)
        )
    assert evidence.isfinite().all()
    assert moved.log_weights.isfinite().all()
    with pytest.raises(ValueError, match="some weight in every row"):
        systematic_resampling(weights)
