"""Identities of the paper, each on the library's own losses, models and beliefs."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import MultivariateNormal, Normal, kl_divergence
from torchrl.objectives import SoftUpdate

from torchrl_vjepa import (
    VJEPA,
    DiagGaussianHead,
    JEPALoss,
    Predictor,
    TargetScale,
    VJEPALoss,
    linear_encoder,
    rollout,
)

DELTA = 1e-9  # standard deviation of a target distribution that is a point mass in all but name


def make_model(
    observation_dim: int, latent_dim: int, *, std: float = DELTA, action_dim: int = 0, **kwargs: Any
) -> VJEPA:
    """Linear model with a constant predicted variance and a target of fixed scale."""
    kwargs.setdefault("head", DiagGaussianHead("constant", log_var_range=(-40.0, 16.0)))
    return VJEPA(
        linear_encoder(observation_dim, latent_dim),
        Predictor(latent_dim, action_dim, **kwargs),
        target_scale=TargetScale(latent_dim, kind="constant", init_std=std, log_var_range=(-80.0, 16.0)),
    ).double()


def associated(loss: Any, eps: float = 0.99) -> Any:
    SoftUpdate(loss, eps=eps)
    return loss


def pairs(context: Tensor, target: Tensor) -> TensorDict:
    """One window of two steps per sample."""
    return TensorDict(observation=torch.stack([context, target], 1), batch_size=(len(context), 2))


def exact_normal(num: int, dim: int) -> Tensor:
    """Samples with mean exactly zero and covariance exactly the identity."""
    x = torch.randn(num, dim, dtype=torch.float64)
    x = x - x.mean(0)
    root = torch.linalg.cholesky(x.mT @ x / num)
    return torch.linalg.solve_triangular(root, x.mT, upper=False).mT


def linear_gaussian(num: int, a: Tensor) -> tuple[Tensor, Tensor]:
    """Stationary z' = a z + w whose sample moments are those of the system."""
    z, w = exact_normal(num, 2 * len(a)).chunk(2, -1)
    return z, z * a + w * (1 - a**2).sqrt()


def set_weights(model: VJEPA, encoder: Tensor, trunk: Tensor, log_var: Tensor) -> None:
    with torch.no_grad():
        model.encoder.module.network.weight.copy_(encoder)
        model.predictor.trunks[0].weight.copy_(trunk)
        model.predictor.constants[0].copy_(log_var)


# --- objective


@pytest.mark.parametrize("log_var", [-2.0, 0.0, 1.5])
def test_deterministic_jepa_is_a_special_case_of_vjepa(log_var: float) -> None:
    """eq:vjepa_objective to eq:JEPA_squared_loss: with a delta target and a fixed variance the gradients are
    those of the squared loss over 2 sigma^2.
    """
    model = make_model(6, 3, action_dim=2, skips=(1, 2))
    with torch.no_grad():
        model.predictor.constants.fill_(log_var)
    variational, squared = associated(VJEPALoss(model, target_kl_coeff=0.5)), associated(JEPALoss(model))
    windows = TensorDict(
        observation=torch.randn(8, 5, 6, dtype=torch.float64),
        action=torch.randn(8, 5, 2, dtype=torch.float64),
        batch_size=(8, 5),
    )
    trained = [model.encoder.module.network.weight, *(trunk.weight for trunk in model.predictor.trunks)]
    total = sum(value for key, value in variational(windows).items() if key.startswith("loss_"))
    ours = torch.autograd.grad(total, trained)
    theirs = torch.autograd.grad(squared(windows)["loss_prediction"], trained)
    variance = model.predictor.dist(torch.zeros(3).double(), torch.zeros(2).double()).variance[0]
    assert variance.item() == pytest.approx(math.exp(log_var), rel=1e-5)
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other / (2 * variance), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("log_var", [-2.0, 0.0, 1.5])
def test_squared_loss_equals_gaussian_likelihood(log_var: float) -> None:
    """-log N = |error|^2 / 2 sigma^2 + d/2 log(2 pi sigma^2), pair by pair."""
    model = make_model(6, 3)
    with torch.no_grad():
        model.predictor.constants.fill_(log_var)
    windows = TensorDict(observation=torch.randn(8, 5, 6, dtype=torch.float64), batch_size=(8, 5))
    nll = associated(VJEPALoss(model, reduction="none"))(windows)["loss_nll"][:, :-1]
    error = associated(JEPALoss(model, reduction="none"))(windows)["loss_prediction"][:, :-1]
    variance = model.predictor.dist(torch.zeros(3).double()).variance[0].item()
    constant = 1.5 * math.log(2 * math.pi * variance)
    torch.testing.assert_close(nll, error / (2 * variance) + constant, rtol=1e-6, atol=1e-6)


def test_eq_vjepa_objective_regularises_the_target_towards_the_reference() -> None:
    """The second term: beta E KL(q(Z | x) || N(0, I)), zero for a target that is the reference itself."""
    model, beta = make_model(6, 3, std=0.5), 0.3
    loss = associated(VJEPALoss(model, target_kl_coeff=beta, collapse_rank=0.0))
    windows = TensorDict(observation=torch.randn(8, 5, 6, dtype=torch.float64), batch_size=(8, 5))
    latent = windows["observation"] @ model.encoder.module.network.weight.detach().mT
    reference = Normal(torch.zeros(3).double(), torch.ones(3).double())
    kl = kl_divergence(Normal(latent, 0.5), reference).sum(-1).mean()
    terms = loss(windows)
    assert terms["loss_target_kl"].item() == pytest.approx(beta * kl.item(), rel=1e-5)
    assert terms["target_kl"].item() == pytest.approx(kl.item(), rel=1e-5)
    model = make_model(6, 3, std=1.0)
    model.encoder.module.network.weight.data.zero_()
    loss = associated(VJEPALoss(model, target_kl_coeff=beta, collapse_rank=0.0))
    assert loss(windows)["loss_target_kl"].item() == pytest.approx(0.0, abs=1e-6)


def test_ema_rule() -> None:
    """eq:target_encoder_weights_EMA: theta' <- tau theta' + (1 - tau) theta, several times."""
    tau = 0.9
    model = make_model(6, 3)
    loss = JEPALoss(model)
    updater = SoftUpdate(loss, eps=tau)
    weight = model.encoder.module.network.weight
    target = weight.detach().clone()
    windows = TensorDict(observation=torch.randn(4, 3, 6, dtype=torch.float64), batch_size=(4, 3))
    for _ in range(5):
        with torch.no_grad():
            weight.add_(torch.randn_like(weight))
        target = tau * target + (1 - tau) * weight.detach()
        updater.step()
        latent, following = windows["observation"][:, :-1] @ weight.mT, windows["observation"][:, 1:]
        error = model.predictor.dist(latent).mean - following @ target.mT
        torch.testing.assert_close(loss(windows)["loss_prediction"], error.square().sum(-1).mean())


def fitted_variance(std: float) -> Tensor:
    """The predictor's variance after fitting targets that the context determines exactly."""
    model = make_model(3, 3, std=std)
    loss = associated(VJEPALoss(model))
    context = torch.randn(300, 3, dtype=torch.float64)
    windows = pairs(context, 0.8 * context)
    optimizer = torch.optim.Adam(model.predictor.parameters(), 0.1)
    for step in range(200):
        for group in optimizer.param_groups:
            group["lr"] = 0.1 * (1 - step / 200)
        optimizer.zero_grad()
        loss(windows)["loss_nll"].backward()
        optimizer.step()
    return model.predictor.dist(torch.zeros(3).double()).variance.detach()


def test_sampled_targets_keep_the_predictors_variance() -> None:
    """Necessity of Target Sampling: sigma_phi^2 -> sigma_theta'^2 instead of zero."""
    variance = fitted_variance(0.5)
    assert (variance / 0.25 - 1).abs().max() < 0.1


def test_mean_targets_collapse_the_predictors_variance() -> None:
    assert fitted_variance(DELTA).max() < 0.025  # still falling; a tenth of the sampled one's


def test_collapsed_encoder_is_not_a_global_optimum_under_target_diversity() -> None:
    """thm:collapse_avoidance.

    Best collapsed solution: the aggregate entropy; what a predictor gains is the information.
    """
    a = torch.tensor([0.9, 0.6], dtype=torch.float64)
    context, target = linear_gaussian(500, a)
    model = make_model(2, 2)
    eye = torch.eye(2, dtype=torch.float64)
    set_weights(model, eye, a.diag(), (1 - a**2).log())
    # The target encoder is diverse, and stays so.
    loss = associated(VJEPALoss(model, target_kl_coeff=0.1, collapse_rank=0.0))
    terms = loss(pairs(context, target))
    good, good_kl = terms["loss_nll"].item(), terms["loss_target_kl"].item()

    model.encoder.module.network.weight.data.zero_()  # f(x) = c for all x
    optimizer = torch.optim.LBFGS(model.predictor.parameters(), max_iter=100, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimizer.zero_grad()
        value = loss(pairs(context, target))["loss_nll"]
        value.backward()
        return value

    optimizer.step(closure)
    terms = loss(pairs(context, target))
    assert terms["effective_rank"] == 0
    aggregate = MultivariateNormal(torch.zeros(2).double(), eye).entropy().item()
    information = -0.5 * (1 - a**2).log().sum().item()
    assert terms["loss_nll"].item() == pytest.approx(aggregate, abs=1e-4)
    assert terms["loss_nll"].item() - good == pytest.approx(information, abs=1e-4)
    assert terms["loss_target_kl"].item() == pytest.approx(good_kl)  # the KL plays no part in the gap


# --- information


@pytest.mark.parametrize("residual_variance", ["head", "batch"])
def test_mutual_information_bound_holds_and_is_tight_at_the_true_model(residual_variance: str) -> None:
    """thm:mi_bound: the closed form -log(1 - a^2) / 2 per dimension at the true model, less elsewhere."""
    a = torch.tensor([0.95, 0.5, 0.0], dtype=torch.float64)
    windows = pairs(*linear_gaussian(600, a))
    truth = -0.5 * (1 - a**2).log().sum().item()
    model = make_model(3, 3)
    eye = torch.eye(3, dtype=torch.float64)

    def bound(encoder: Tensor, trunk: Tensor, log_var: Tensor) -> float:
        set_weights(model, encoder, trunk, log_var)
        loss = associated(VJEPALoss(model, residual_variance=residual_variance))
        return loss(windows)["mutual_information"].item()

    true_variance = (1 - a**2).log()
    assert bound(eye, a.diag(), true_variance) == pytest.approx(truth, abs=1e-4)
    # Invertible encoders keep the information.
    rotation = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64)).Q
    if residual_variance == "batch":
        trunk = rotation @ a.diag() @ rotation.mT
        assert bound(2 * rotation, trunk, true_variance) == pytest.approx(truth, abs=1e-4)
    for scale in (0.1, 0.5, 1.0):
        noise = [scale * torch.randn(shape, dtype=torch.float64) for shape in ((3, 3), (3, 3), (3,))]
        assert bound(eye + noise[0], a.diag() + noise[1], true_variance + noise[2]) < truth - 1e-3


def test_nuisance_invariance() -> None:
    """prop:nuisance_invariance: x = (signal, unpredictable noise): VJEPA gives the noise no weight."""
    num, a = 400, 0.9
    noise_and_signal = exact_normal(num, 6)
    signal, drive = noise_and_signal[:, :1], noise_and_signal[:, 1:2]
    following = a * signal + math.sqrt(1 - a**2) * drive
    noises = 3 * noise_and_signal[:, 2:]
    windows = pairs(torch.cat([signal, noises[:, :2]], 1), torch.cat([following, noises[:, 2:]], 1))
    model = make_model(3, 1)
    with torch.no_grad():
        model.encoder.module.network.weight.copy_(torch.tensor([[0.2, 0.2, -0.2]]))
    loss = VJEPALoss(
        model, residual_variance="batch", marginal_entropy_coeff=1.0, target_kl_coeff=0.0, collapse_rank=0.0
    )
    updater = SoftUpdate(loss, eps=0.9)
    optimizer = torch.optim.Adam(loss.parameters(), 0.02)
    for step in range(300):
        for group in optimizer.param_groups:
            group["lr"] = 0.04 * (1 - step / 300)
        optimizer.zero_grad()
        terms = loss(windows)
        sum(value for key, value in terms.items() if key.startswith("loss_")).backward()
        optimizer.step()
        updater.step()
    weight = model.encoder.module.network.weight.detach()[0].abs()
    assert weight[1:].max() < 0.01 * weight[0]
    # Nothing is lost with the noise.
    assert terms["mutual_information"].item() == pytest.approx(-0.5 * math.log(1 - a**2), abs=0.01)


def test_nuisance_costs_nothing_to_discard() -> None:
    """prop:nuisance_invariance: the minimal representation reaches the optimal loss of the maximal one."""
    samples = exact_normal(800, 4)
    signal, noise, drive = samples[:, :1], samples[:, 1:2], samples[:, 2:3]
    following = torch.cat([0.8 * signal + 0.6 * drive, samples[:, 3:]], 1)
    windows = pairs(torch.cat([signal, noise], 1), following)
    model = make_model(2, 1)
    set_weights(
        model, torch.tensor([[1.0, 0.0]]), torch.tensor([[0.8]]), torch.tensor([math.log(0.36)]).double()
    )
    loss = associated(VJEPALoss(model, collapse_rank=0.0))
    minimal = loss(windows)["loss_nll"].item()
    entropy = 0.5 * math.log(2 * math.pi * math.e * 0.36)  # of z' given (s, n), and given s
    assert minimal == pytest.approx(entropy, abs=1e-5)
    # The target stays the signal's; a context that carries noise can only lose.
    model.encoder.module.network.weight.data[0, 1] = 0.3
    assert loss(windows)["loss_nll"].item() > minimal + 0.01


# --- beliefs


@pytest.mark.parametrize("horizon", [1, 3])
def test_multi_step_belief_equals_kalman_prediction(horizon: int) -> None:
    """A belief N(mu, P) pushed through p_phi has mu <- A mu + B u and P <- A P A' + Q."""
    num = 40_000
    model = make_model(5, 2, action_dim=1)
    a = torch.tensor([[0.9, 0.3], [-0.3, 0.8]], dtype=torch.float64)
    b = torch.tensor([[0.5], [1.0]], dtype=torch.float64)
    q = torch.tensor([0.04, 0.25], dtype=torch.float64)
    with torch.no_grad():
        model.predictor.trunks[0].weight.copy_(torch.cat([a, b], 1))
        model.predictor.constants[0].copy_(q.log())
    mean = torch.tensor([1.0, -2.0], dtype=torch.float64)
    covariance = torch.tensor([[0.5, 0.2], [0.2, 0.3]], dtype=torch.float64)
    generator = torch.Generator().manual_seed(1)
    actions = torch.randn(horizon, 1, dtype=torch.float64)
    white = torch.randn(num, 2, dtype=torch.float64, generator=generator)
    start = mean + white @ torch.linalg.cholesky(covariance).mT
    belief = rollout(
        model.predictor.dist, start, actions.expand(num, -1, -1), "sample", num_samples=1, generator=generator
    )[0].detach()
    point = rollout(model.predictor.dist, mean, actions).detach()
    for t in range(horizon):
        mean = a @ mean + b @ actions[t]
        covariance = a @ covariance @ a.mT + q.diag()
        spread = covariance.diagonal()
        torch.testing.assert_close(point[t], mean)
        assert ((belief[:, t].mean(0) - mean).abs() < 4 * (spread / num).sqrt()).all()
        # Var of a sample covariance: (P_ij^2 + P_ii P_jj) / n.
        error = ((covariance**2 + torch.outer(spread, spread)) / num).sqrt()
        assert ((torch.cov(belief[:, t].mT) - covariance).abs() < 4 * error).all()
