"""Every head in what uses it: predictor, losses, fusion, imagination, planners."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs.utils import check_env_specs
from torchrl.objectives import SoftUpdate

from torchrl_vjepa import (
    BJEPA,
    MPPI,
    VJEPA,
    BJEPALoss,
    DiagGaussianHead,
    EnsembleHead,
    FlowHead,
    FullGaussianHead,
    FusedPredictor,
    GaussianPrior,
    Head,
    LatentEnv,
    LowRankGaussianHead,
    MixtureHead,
    Predictor,
    TargetScale,
    VJEPALoss,
    linear_encoder,
    moments,
    point_estimate,
    quadratic_cost,
    rollout,
    sample,
)
from torchrl_vjepa.distributions import log_score

OBS, LATENT, ACTION = 6, 3, 2
HEADS: dict[str, Callable[[], Head]] = {
    "full": FullGaussianHead,
    "low rank": lambda: LowRankGaussianHead(1),
    "mixture": lambda: MixtureHead(3),
    "flow": lambda: FlowHead(2, 8, 4),
    "ensemble": lambda: EnsembleHead(num_members=3, num_cells=8),
    "ensemble of mixtures": lambda: EnsembleHead(MixtureHead(2), 2, 4),
}
EVERY = pytest.mark.parametrize("name", HEADS)


def windows(side_info_dim: int = 0) -> TensorDict:
    entries = {"observation": torch.randn(4, 6, OBS), "action": torch.randn(4, 6, ACTION)}
    if side_info_dim:
        entries["side_info"] = torch.randn(4, 6, side_info_dim)
    return TensorDict(entries, batch_size=(4, 6))


@EVERY
@pytest.mark.parametrize("trunk", ["linear", "mlp"])
@pytest.mark.parametrize("residual", [False, True])
def test_predictor_with_every_trunk_skip_and_side_info(name: str, trunk: Any, residual: bool) -> None:
    predictor = Predictor(
        LATENT, ACTION, head=HEADS[name](), skips=(1, 3), trunk=trunk, num_cells=[8], side_info_dim=2,
        residual=residual,
    )  # fmt: skip
    latent, side_info = torch.randn(5, LATENT), torch.randn(5, 2)
    for skip in (1, 3):
        p = predictor.dist(latent, torch.randn(5, skip, ACTION), skip=skip, side_info=side_info)
        assert (p.batch_shape, p.event_shape) == ((5,), (LATENT,))
        assert p.log_prob(latent).isfinite().all()
    out = predictor(
        TensorDict(latent=latent, action=torch.randn(5, ACTION), side_info=side_info, batch_size=5)
    )
    assert out["next", "latent"].shape == (5, LATENT)


@EVERY
@pytest.mark.parametrize("residual_variance", ["head", "batch"])
def test_the_likelihood_falls_in_training(name: str, residual_variance: Any) -> None:
    model = VJEPA(linear_encoder(OBS, LATENT), Predictor(LATENT, ACTION, head=HEADS[name](), skips=(1, 2)))
    loss = VJEPALoss(model, residual_variance=residual_variance, collapse_rank=0.0)
    updater = SoftUpdate(loss, eps=0.99)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    data, history = windows(), []
    for _ in range(25):
        losses = loss(data)
        sum(v for k, v in losses.items() if k.startswith("loss_")).backward()
        assert all(p.grad is None or p.grad.isfinite().all() for p in loss.parameters())
        optimizer.step()
        optimizer.zero_grad()
        updater.step()
        history.append(float(losses["nll_skip_1"]))
    assert sum(history[-5:]) < sum(history[:5])
    out = model(data[:, 0])
    assert out["loc"].shape == out["scale"].shape == (4, LATENT)


def test_members_of_an_ensemble_train_by_their_own_likelihoods() -> None:
    predictor = Predictor(LATENT, ACTION, head=HEADS["ensemble"]())
    scale = TargetScale(LATENT, kind="constant", init_std=1e-3)
    model = VJEPA(linear_encoder(OBS, LATENT), predictor, target_scale=scale)
    data = windows()
    with torch.no_grad():
        z = model.encoder(data.clone())["latent"]
        p = predictor.dist(z[:, :-1], data["action"][:, :-1])
        own, mixed = log_score(p, z[:, 1:]).mean(), p.log_prob(z[:, 1:]).mean()
    for residual_variance in ("head", "batch"):
        loss = VJEPALoss(model, residual_variance=residual_variance)
        SoftUpdate(loss, eps=0.99)
        found = -loss(data)["nll_skip_1"]
        assert abs(float(found - own)) < 0.1 * float(mixed - own)


@EVERY
def test_training_under_autocast(name: str) -> None:
    predictor = Predictor(LATENT, ACTION, head=HEADS[name](), trunk="mlp", num_cells=[8])
    loss = BJEPALoss(BJEPA(linear_encoder(OBS, LATENT), predictor))
    SoftUpdate(loss, eps=0.99)
    with torch.autocast("cpu", torch.bfloat16):
        losses = loss(windows())
    sum(v for k, v in losses.items() if k.startswith("loss_")).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in loss.parameters())


@EVERY
def test_structural_divergence_trains_the_prior(name: str) -> None:
    model = BJEPA(linear_encoder(OBS, LATENT), Predictor(LATENT, ACTION, head=HEADS[name]()))
    loss = BJEPALoss(model, structural_kl_coeff=1.0)
    SoftUpdate(loss, eps=0.99)
    losses = loss(windows())
    # By draws it may be negative, but not by much.
    assert float(losses["structural_kl"]) > -0.5
    losses["loss_structural_kl"].backward()
    prior = [p for key, p in loss.named_parameters() if "prior" in key]
    assert prior
    assert all(p.grad.abs().sum() > 0 for p in prior)


def test_number_of_draws_is_checked() -> None:
    model = BJEPA(linear_encoder(OBS, LATENT), Predictor(LATENT))
    with pytest.raises(ValueError, match="num_kl_samples must be at least 2, got 1"):
        BJEPALoss(model, num_kl_samples=1)


@pytest.mark.parametrize("name", ["full", "low rank", "mixture", "ensemble"])
def test_fusion_with_a_sharp_prior_is_the_prior(name: str) -> None:
    predictor = Predictor(LATENT, ACTION, head=HEADS[name]()).double()
    goal = torch.tensor([0.5, -0.5, 1.0])
    fused = FusedPredictor(predictor, GaussianPrior(LATENT, mean=goal, std=1e-3).double())
    p = fused.dist(torch.zeros(5, LATENT).double(), torch.zeros(5, ACTION).double())
    mean, covariance = moments(p)
    torch.testing.assert_close(mean, goal.double().expand(5, LATENT), rtol=0, atol=1e-3)
    assert (covariance.diagonal(dim1=-2, dim2=-1) < 1.1e-6).all()


def imagined(name: str, **kwargs: Any) -> LatentEnv:
    predictor = Predictor(LATENT, ACTION, head=HEADS[name](), residual=True)
    return LatentEnv(
        predictor, action_spec=Bounded(-1, 1, (ACTION,)), cost=quadratic_cost(torch.ones(LATENT)), **kwargs
    )


@EVERY
@pytest.mark.parametrize("how", ["mean", "mode", "sample"])
def test_imagination_and_planning(name: str, how: Any) -> None:
    env = imagined(name, how=how, num_samples=4 if how == "sample" else 1)
    if how != "mode":  # torchrl steps the environment many times
        check_env_specs(env)
    planner = MPPI(env, planning_horizon=2, optim_steps=1, num_candidates=8, seed=0)
    out = planner(TensorDict(latent=torch.randn(3, LATENT), batch_size=3))
    assert out["action"].shape == (3, ACTION)
    assert out["action"].isfinite().all()


@EVERY
def test_candidates_share_their_random_numbers(name: str) -> None:
    env = imagined(name, how="sample", num_samples=6)
    plan = torch.rand(1, 3, ACTION) - 0.5
    costs = env.objective(
        torch.zeros(LATENT), plan.expand(9, 3, ACTION), generator=torch.Generator().manual_seed(0)
    )
    # The same plan costs the same to the last digits, whatever is drawn.
    torch.testing.assert_close(costs, costs[:1].expand(9))
    again = env.objective(torch.zeros(LATENT), plan, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(again, costs[:1])


@EVERY
@pytest.mark.parametrize("how", ["mean", "sample"])
def test_plans_have_gradients(name: str, how: Any) -> None:
    env = imagined(name, how=how, num_samples=16 if how == "sample" else 1)
    actions = torch.zeros(2, 3, ACTION, requires_grad=True)
    costs = env.objective(torch.ones(LATENT), actions, generator=torch.Generator().manual_seed(0))
    costs.sum().backward()
    assert (actions.grad != 0).all()
    assert actions.grad.isfinite().all()


@EVERY
def test_rollouts_of_a_generator_are_deterministic(name: str) -> None:
    predictor = Predictor(LATENT, ACTION, head=HEADS[name]())
    before = torch.get_rng_state()
    first, second = (
        rollout(
            predictor.dist, torch.ones(5, LATENT), torch.zeros(5, 4, ACTION), "sample", 3,
            generator=torch.Generator().manual_seed(2),
        )
        for _ in range(2)
    )  # fmt: skip
    assert torch.equal(first, second)
    assert torch.equal(before, torch.get_rng_state())


# What the heads are for ---------------------------------------------------------------------------


def fit(head: Head, x: Tensor, y: Tensor, steps: int, lr: float = 1e-2, trunk: Any = "linear") -> Predictor:
    """Maximum likelihood of the head's own kind, full batch."""
    predictor = Predictor(x.shape[-1], head=head, trunk=trunk, num_cells=[16], bias=True)
    optimizer = torch.optim.Adam(predictor.parameters(), lr=lr)
    for _ in range(steps):
        optimizer.zero_grad()
        (-log_score(predictor.dist(x), y).mean()).backward()
        optimizer.step()
    return predictor


def fork(num: int, seed: int) -> tuple[Tensor, Tensor]:
    """Right or left of a wall, and forward by a length that goes with the side."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(num, 2, generator=generator)
    side = (torch.rand(num, 1, generator=generator) < 0.5).float() * 2 - 1
    noise = 0.2 * torch.randn(num, 2, generator=generator)
    return x, x + torch.cat([2 * side, 0.5 * side], dim=-1) + noise


def test_heads_rank_by_what_they_can_express_on_a_fork() -> None:
    """Test log-likelihood: flow and mixture over full over diagonal; only they leave the wall empty."""
    x, y = fork(512, 0)
    test_x, test_y = fork(2000, 1)
    score, wall = {}, {}
    heads = {
        "diagonal": DiagGaussianHead("constant"),
        "full": FullGaussianHead("constant"),
        "mixture": MixtureHead(2),
        "flow": FlowHead(2, 16),
    }
    for name, head in heads.items():
        predictor = fit(head, x, y, 200, 2e-2)
        with torch.no_grad():
            p = predictor.dist(test_x)
            score[name] = float(p.log_prob(test_y).mean())
            drawn = sample(p, (20,), generator=torch.Generator().manual_seed(0)) - test_x
        wall[name] = float((drawn[..., 0].abs() < 1).float().mean())
        if name == "mixture":  # the mean lies in the wall, the mode at one of the exits
            assert ((p.mean - test_x)[..., 0].abs() < 1).float().mean() > 0.95
            assert ((point_estimate(p, "mode") - test_x)[..., 0].abs() > 1.5).float().mean() > 0.95
    assert score["diagonal"] < score["full"] - 0.3
    assert score["full"] < min(score["mixture"], score["flow"]) - 0.3
    # Minus the entropy of the truth is the best that anything can reach.
    entropy = 2 * (0.5 * math.log(2 * math.pi * math.e) + math.log(0.2)) + math.log(2)
    assert -entropy - 0.5 < score["mixture"] < -entropy + 0.1
    assert wall["mixture"] < 0.05
    assert wall["flow"] < 0.05
    assert wall["diagonal"] > 0.2


def test_an_ensemble_knows_what_it_has_not_seen() -> None:
    """The paper's remark on ensembles, measured: disagreement is ignorance, members' variance is noise."""
    inside, outside = torch.linspace(-0.9, 0.9, 50).unsqueeze(-1), torch.tensor([[-4.0], [4.0]])
    epistemic, aleatoric, far = {}, {}, {}
    for num in (8, 64, 512):
        generator = torch.Generator().manual_seed(num)
        x = 2 * torch.rand(num, 1, generator=generator) - 1
        y = torch.sin(3 * x) + 0.1 * torch.randn(num, 1, generator=generator)
        head = EnsembleHead(DiagGaussianHead("constant", log_var_range=(-8.0, 4.0)), 5, 32)
        predictor = fit(head, x, y, 500, 2e-2)
        with torch.no_grad():
            p, q = predictor.dist(inside), predictor.dist(outside)
        epistemic[num] = float(p.epistemic_variance.mean())
        aleatoric[num] = float(p.aleatoric_variance.mean())
        far[num] = float(q.epistemic_variance.mean())
    # It grows away from the data, however many there are.
    assert all(far[num] > 1000 * epistemic[num] for num in far)
    # It falls with data, and what is noise stays.
    assert epistemic[512] < 0.5 * epistemic[8]
    assert epistemic[512] < 0.05 * aleatoric[512]
    assert abs(math.log(aleatoric[512] / 0.1**2)) < 0.3
    assert abs(math.log(aleatoric[512] / aleatoric[64])) < 0.5
