"""Adaptive coefficients: multipliers solved by hand, divergences at their targets, no collapse."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, ProbabilisticTensorDictModule, TensorDictModule
from tensordict.nn import ProbabilisticTensorDictSequential as Sequential
from torch import Tensor, nn
from torchrl.objectives import ClipPPOLoss, LossModule, SoftUpdate

from torchrl_vjepa import (
    BJEPA,
    VJEPA,
    AdaptiveCoefficient,
    BJEPALoss,
    DiagGaussianHead,
    GaussianPrior,
    Predictor,
    TargetScale,
    VJEPALoss,
    linear_encoder,
)

A, R = 0.95, 1 - 0.95**2  # s' = A s + w, w ~ N(0, R I): the signal has unit variance


class Quadratic(LossModule):
    """(theta - a)^2 / 2 + weight * K(theta): everything can be solved by hand."""

    @dataclass
    class _AcceptedKeys:
        pass

    default_keys = _AcceptedKeys
    _schedulable_buffers = frozenset({"weight"})
    out_keys = ["loss_fit", "loss_term", "term"]

    def __init__(self, a: float, term: Callable[[Tensor], Tensor], weight: float, sign: float = 1.0) -> None:
        super().__init__()
        self.theta = nn.Parameter(torch.tensor(a, dtype=torch.float64))
        self.a, self.term, self.sign = a, term, sign
        self.register_coeff_buffer("weight", weight, dtype=torch.float64)

    def forward(self, tensordict: TensorDict) -> TensorDict:
        term = self.term(self.theta)
        fit = 0.5 * (self.theta - self.a) ** 2
        return TensorDict(
            {"loss_fit": fit, "loss_term": self.sign * self.weight * term, "term": term.detach()}
        )


def descend(loss: Quadratic, balancer: AdaptiveCoefficient, steps: int = 1500) -> None:
    optimizer = torch.optim.SGD(loss.parameters(), 0.01)
    for _ in range(steps):
        losses = loss(TensorDict())
        optimizer.zero_grad()
        (losses["loss_fit"] + losses["loss_term"]).backward()
        optimizer.step()
        balancer.step(losses)


# --- a problem solved by hand


@pytest.mark.parametrize("start", [1e-2, 1.0, 1e2])
def test_converges_to_the_multiplier_of_a_quadratic_problem(start: float) -> None:
    """min (theta - 3)^2 / 2 subject to theta^2 / 2 <= 1/2: theta = 1 and lambda = 3 / 1 - 1."""
    loss = Quadratic(3.0, lambda theta: 0.5 * theta**2, start)
    descend(loss, AdaptiveCoefficient(loss, "weight", "term", 0.5, rate=0.02))
    assert loss.weight.item() == pytest.approx(2.0, rel=1e-3)
    assert loss.theta.item() == pytest.approx(1.0, rel=1e-3)


def test_a_slack_constraint_has_no_multiplier() -> None:
    """Complementary slackness: the coefficient falls to its bound, and the fit is free."""
    loss = Quadratic(0.5, lambda theta: 0.5 * theta**2, 1.0)
    descend(loss, AdaptiveCoefficient(loss, "weight", "term", 0.5, rate=0.05, bounds=(1e-5, 10.0)))
    assert loss.weight.item() == pytest.approx(1e-5)
    assert loss.theta.item() == pytest.approx(0.5, rel=1e-4)


def test_an_impossible_constraint_stops_at_the_upper_bound() -> None:
    loss = Quadratic(1.0, lambda theta: 0.5 * theta**2 + 2.0, 1.0)
    descend(loss, AdaptiveCoefficient(loss, "weight", "term", 1.0, rate=0.05, bounds=(1e-5, 8.0)), 200)
    assert loss.weight.item() == 8.0


@pytest.mark.parametrize("target", [2.0, -0.5])
def test_a_lower_limit_turns_the_sign(target: float) -> None:
    """min (theta - a)^2 / 2 subject to theta >= target: lambda = target - a; targets may be negative."""
    loss = Quadratic(target - 1.5, lambda theta: theta, 0.1, sign=-1.0)
    descend(loss, AdaptiveCoefficient(loss, "weight", "term", target, rate=0.02, limit="lower"))
    assert loss.weight.item() == pytest.approx(1.5, rel=1e-3)
    assert loss.theta.item() == pytest.approx(target, rel=1e-3)


def test_one_step_is_the_formula() -> None:
    for value, exponent in ((0.4, -0.2), (0.55, 0.1), (3.0, 1.0), (-9.0, -1.0), (math.inf, 1.0)):
        loss = Quadratic(0.0, lambda theta: theta, 0.7)
        balancer = AdaptiveCoefficient(loss, "weight", "term", 0.5, rate=0.3)
        balancer.step(TensorDict(term=torch.tensor(value, dtype=torch.float64)))
        assert loss.weight.item() == pytest.approx(0.7 * math.exp(0.3 * exponent))


def test_damping_follows_the_change_of_the_excess() -> None:
    """Over several steps: the rate times the sum of the excess, damping times its last minus its first."""
    loss = Quadratic(0.0, lambda theta: theta, 0.7)
    balancer = AdaptiveCoefficient(loss, "weight", "term", 2.0, rate=0.3, damping=0.8)
    values = (2.5, 1.0, 9.0, 3.0)
    for value in values:
        balancer.step(TensorDict(term=torch.tensor(value, dtype=torch.float64)))
    excess = [min(value / 2.0 - 1, 1.0) for value in values]
    exponent = 0.3 * sum(excess) + 0.8 * (excess[-1] - excess[0])
    assert loss.weight.item() == pytest.approx(0.7 * math.exp(exponent))


def test_what_is_not_a_number_moves_nothing() -> None:
    loss = Quadratic(0.0, lambda theta: theta, 0.7)
    balancer = AdaptiveCoefficient(loss, "weight", "term", 0.5)
    for value in (0.5, math.nan, 0.7):
        balancer.step(TensorDict(term=torch.tensor(value, dtype=torch.float64)))
        assert loss.weight.item() == pytest.approx(0.7)
    balancer.step(TensorDict(term=torch.tensor(0.6, dtype=torch.float64)))  # damping and rate again
    assert loss.weight.item() == pytest.approx(0.7 * math.exp(0.01 * 0.2 - 0.2))


# --- beta and gamma


def signal_and_noise(num: int, steps: int, generator: torch.Generator) -> TensorDict:
    """Two predictable dimensions and two of noise."""
    signal = torch.randn(num, 2, generator=generator)
    rows = []
    for _ in range(steps):
        rows.append(torch.cat([signal, torch.randn(num, 2, generator=generator)], 1))
        signal = A * signal + math.sqrt(R) * torch.randn(num, 2, generator=generator)
    return TensorDict(observation=torch.stack(rows, 1), batch_size=(num, steps))


def formed(kind: type[VJEPA], std: float, trunk: float = A) -> VJEPA:
    """A model that has found the signal and its dynamics."""
    scale = TargetScale(2, init_std=std)
    predictor = Predictor(2, head=DiagGaussianHead("constant"))
    prior = {"structural_prior": GaussianPrior(2)} if kind is BJEPA else {}
    model = kind(linear_encoder(4, 2), predictor, target_scale=scale, **prior)
    with torch.no_grad():
        model.encoder.module.network.weight.copy_(torch.eye(2, 4))
        predictor.trunks[0].weight.copy_(trunk * torch.eye(2))
        predictor.constants.fill_(math.log(R + std**2))
    return model


def update(
    loss: VJEPALoss,
    windows: TensorDict,
    optimizer: torch.optim.Optimizer,
    updater: SoftUpdate,
    balancers: Sequence[AdaptiveCoefficient],
) -> TensorDict:
    """One step of everything; the losses before it."""
    losses = loss(windows)
    optimizer.zero_grad()
    sum(value.sum() for name, value in losses.items() if name.startswith("loss_")).backward()
    optimizer.step()
    updater.step()
    for balancer in balancers:
        balancer.step(losses)
    return losses


def train(
    loss: VJEPALoss,
    parameters: Any,
    balancers: Sequence[AdaptiveCoefficient],
    steps: int,
    key: str,
    *,
    generator: torch.Generator | None = None,
    adam: bool = False,
    rate: float = 0.05,
) -> Tensor:
    """The values of a diagnostic in every step."""
    updater = SoftUpdate(loss, eps=0.9)
    optimizer = (torch.optim.Adam if adam else torch.optim.SGD)(parameters, rate)
    generator = generator or torch.Generator().manual_seed(0)
    history = []
    for _ in range(steps):
        losses = update(loss, signal_and_noise(64, 5, generator), optimizer, updater, balancers)
        history.append(losses[key])
    return torch.stack(history)


def test_beta_converges_to_the_multiplier_solved_by_hand() -> None:
    """Encoder and mean held fixed, beta from 100 times too small, right, and 100 times too large.

    With target variance s and predicted variance s + R in each of D dimensions, the KL is
    (1 + s - 1 - log s) D / 2, and stationarity in s reads 1 / (s + R) = beta (1 / s - 1).
    """
    s = 0.2
    target = s - math.log(s)
    exact = s / ((1 - s) * (s + R))
    models = [formed(VJEPA, 0.8) for _ in range(3)]
    loss = VJEPALoss(models, target_kl_coeff=exact, target_scale_gradient="both")
    balancer = AdaptiveCoefficient(loss, "target_kl_coeff", "target_kl", target, rate=0.2, damping=3.0)
    loss.target_kl_coeff.mul_(torch.tensor([0.01, 1.0, 100.0]))
    moving = [p for n, p in loss.named_parameters() if n.startswith("scale") or n.endswith("constants")]
    kl = train(loss, moving, [balancer], 400, "target_kl", adam=True, rate=0.1)
    assert (kl[0] / target).max() < 0.75  # it starts elsewhere
    torch.testing.assert_close(kl[-100:].mean(0), torch.full((3,), target), rtol=0.02, atol=0)
    torch.testing.assert_close(loss.target_kl_coeff, torch.full((3,), exact), rtol=0.15, atol=0)


def test_gamma_keeps_the_structural_kl_at_its_target() -> None:
    """Everything moves, from gammas 100 times too small and too large."""
    models = [formed(BJEPA, 0.3) for _ in range(2)]
    loss = BJEPALoss(models, target_scale_gradient="none", marginal_entropy_coeff=1.0)
    balancer = AdaptiveCoefficient(loss, "structural_kl_coeff", "structural_kl", 0.5, rate=0.05)
    loss.structural_kl_coeff.copy_(torch.tensor([0.005, 50.0]))
    kl = train(loss, loss.parameters(), [balancer], 400, "structural_kl", rate=0.02)
    torch.testing.assert_close(kl[-100:].mean(0), torch.full((2,), 0.5), rtol=0.03, atol=0)
    low, high = loss.structural_kl_coeff.tolist()
    assert low == pytest.approx(high, rel=0.1)
    assert 0.05 < low < 5


@pytest.mark.parametrize("coefficient", ["beta", "gamma"])
def test_balancing_prevents_the_collapse_under_a_too_strong_coefficient(coefficient: str) -> None:
    """ "If regularization is too strong, the representation collapses": not if it adapts.

    With weight decay the encoder lives on the gradient of the likelihood. A strong beta makes the
    targets all noise, a strong gamma makes the prediction independent of the context: it starves.
    """
    if coefficient == "beta":
        kind, std, decay, strong, target = VJEPA, 0.3, 0.3, 30.0, 2.5
        name, options = "target_kl", {"target_kl_coeff": strong, "target_scale_gradient": "both"}
    else:
        kind, std, decay, strong, target = BJEPA, 0.1, 0.1, 10.0, 1.5
        name = "structural_kl"
        options = {"structural_kl_coeff": strong, "target_scale_gradient": "none", "target_kl_coeff": 0.0}
    build = VJEPALoss if kind is VJEPA else BJEPALoss
    spread = {}
    for adaptive in (False, True):
        loss = build(formed(kind, std), collapse_rank=0.0, **options)
        groups = [
            {"params": [p for p in loss.parameters() if p.ndim > 1], "weight_decay": decay},
            {"params": [p for p in loss.parameters() if p.ndim < 2]},
        ]
        balancer = [AdaptiveCoefficient(loss, f"{name}_coeff", name, target, rate=0.1)] if adaptive else []
        information = train(loss, groups, balancer, 250, "mutual_information")[-1].item()
        weight = loss.get_model().encoder.module.network.weight.detach()
        spread[adaptive] = (weight[:, :2].norm().item() / math.sqrt(2), information)
    assert spread[False][0] < 0.4
    assert spread[False][1] < 0.1
    assert spread[True][0] > 0.75
    assert spread[True][1] > 0.8


# --- the diagnostic


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_target_kl_is_in_nats_without_beta(reduction: str) -> None:
    """Mean over the steps that count of KL(q || N(0, I)), from torch.distributions."""
    model = VJEPA(linear_encoder(4, 2), Predictor(2), target_scale=TargetScale(2, init_std=0.4))
    loss = VJEPALoss(model, target_kl_coeff=7.0, reduction=reduction)
    SoftUpdate(loss, eps=0.9)
    windows = signal_and_noise(6, 5, torch.Generator().manual_seed(0))
    keep = torch.arange(30).reshape(6, 5) % 4 > 0
    windows["collector", "mask"] = keep
    latent = windows["observation"] @ model.encoder.module.network.weight.mT
    q = torch.distributions.Normal(latent, 0.4)
    kl = torch.distributions.kl_divergence(q, torch.distributions.Normal(0.0, 1.0)).sum(-1)
    torch.testing.assert_close(loss(windows)["target_kl"], kl[keep].mean().detach())
    assert not loss(windows)["target_kl"].requires_grad
    del windows["collector"]
    torch.testing.assert_close(loss(windows)["target_kl"], kl.mean().detach())


# --- several models


def test_models_of_a_list_are_balanced_as_each_alone() -> None:
    """Two coefficients that move at once; one vector entry for each model."""

    def run(models: Any) -> tuple[BJEPALoss, Tensor]:
        loss = BJEPALoss(models, target_scale_gradient="both", marginal_entropy_coeff=0.1)
        balancers = [
            AdaptiveCoefficient(loss, "target_kl_coeff", "target_kl", 1.7, rate=0.3),
            AdaptiveCoefficient(loss, "structural_kl_coeff", "structural_kl", 0.9, rate=0.2),
        ]
        updater = SoftUpdate(loss, eps=0.9)
        optimizer = torch.optim.Adam(loss.parameters(), 0.01)
        generator = torch.Generator().manual_seed(0)
        for step in range(5):
            windows = signal_and_noise(8, 5, generator).double()
            torch.manual_seed(step)
            update(loss, windows, optimizer, updater, balancers)
        return loss, torch.stack([loss.target_kl_coeff, loss.structural_kl_coeff])

    starts = [(0.3, 0.5), (0.8, 0.9), (0.1, 0.2)]
    several, coefficients = run([formed(BJEPA, *start).double() for start in starts])
    assert coefficients.shape == (2, 3)
    assert len(set(coefficients.flatten().tolist())) == 6
    for i, start in enumerate(starts):
        alone, coefficient = run(formed(BJEPA, *start).double())
        torch.testing.assert_close(coefficients[:, i], coefficient, rtol=1e-8, atol=0)
        state = several.get_model(i).state_dict()
        torch.testing.assert_close(state, alone.get_model().state_dict(), rtol=1e-8, atol=1e-10)


def test_a_diverged_model_keeps_its_coefficient_and_spoils_no_other() -> None:
    models = [formed(VJEPA, 0.3) for _ in range(2)]
    loss = VJEPALoss(models, target_scale_gradient="both", collapse_rank=0.0)
    SoftUpdate(loss, eps=0.9)
    balancer = AdaptiveCoefficient(loss, "target_kl_coeff", "target_kl", 100.0, rate=0.1)
    with torch.no_grad():
        loss.encoder_params["module", "network", "weight"][1].fill_(math.nan)
        loss.target_encoder_params.data["module", "network", "weight"][1].fill_(math.nan)
    balancer.step(loss(signal_and_noise(8, 5, torch.Generator().manual_seed(0))))
    first, second = loss.target_kl_coeff.tolist()
    assert first < 0.0095
    assert second == pytest.approx(0.01)


def test_a_sweep_over_a_coefficient_is_one_batch() -> None:
    """A buffer with one entry for each model weighs each model's term by its own."""
    models = [formed(VJEPA, 0.3) for _ in range(3)]
    loss = VJEPALoss(models)
    SoftUpdate(loss, eps=0.9)
    windows = signal_and_noise(8, 5, torch.Generator().manual_seed(0))
    unit = loss(windows)["target_kl"]
    loss.register_buffer("target_kl_coeff", torch.tensor([0.0, 0.5, 4.0]))
    losses = loss(windows)
    torch.testing.assert_close(losses["loss_target_kl"], unit * torch.tensor([0.0, 0.5, 4.0]))
    torch.testing.assert_close(losses["loss_target_kl"] > 0, torch.tensor([False, True, True]))
    loss.target_kl_coeff = 2.0  # a number is every model's
    torch.testing.assert_close(loss(windows)["loss_target_kl"], 2 * unit)
    loss.register_buffer("target_kl_coeff", torch.ones(2))
    with pytest.raises(ValueError, match=r"target_kl_coeff must be a scalar or, .* num_models=3"):
        loss(windows)


# --- resuming


@pytest.mark.parametrize("several", [False, True])
def test_resuming_changes_nothing(several: bool) -> None:
    def build() -> tuple[VJEPALoss, AdaptiveCoefficient]:
        model = [formed(VJEPA, 0.5) for _ in range(2)] if several else formed(VJEPA, 0.5)
        loss = VJEPALoss(model, target_scale_gradient="both")
        return loss, AdaptiveCoefficient(loss, "target_kl_coeff", "target_kl", 3.0, rate=0.1)

    def go(loss: VJEPALoss, balancer: AdaptiveCoefficient, generator: torch.Generator, steps: int) -> Tensor:
        torch.manual_seed(steps)
        return train(loss, loss.parameters(), [balancer], steps, "target_kl", generator=generator)

    loss, balancer = build()
    generator = torch.Generator().manual_seed(0)
    go(loss, balancer, generator, 4)
    balancer.target, balancer.rate = 2.0, 0.2
    saved = {"loss": loss.state_dict(), "balancer": balancer.state_dict()}
    saved = {
        name: {k: v.clone() if isinstance(v, Tensor) else v for k, v in saved[name].items()} for name in saved
    }
    at = generator.get_state()
    coefficient = loss.target_kl_coeff.clone()

    again, other = build()
    other.load_state_dict(saved["balancer"])
    torch.testing.assert_close(again.target_kl_coeff, coefficient, rtol=0, atol=0)
    assert (other.target, other.rate) == (2.0, 0.2)
    again, other = build()
    again.load_state_dict(saved["loss"])  # holds the coefficient too
    torch.testing.assert_close(again.target_kl_coeff, coefficient, rtol=0, atol=0)

    other.load_state_dict(saved["balancer"])
    again.load_state_dict(saved["loss"])
    reference = go(loss, balancer, generator, 3)
    generator.set_state(at)
    torch.testing.assert_close(go(again, other, generator, 3), reference, rtol=0, atol=0)
    torch.testing.assert_close(again.target_kl_coeff, loss.target_kl_coeff, rtol=0, atol=0)
    assert not torch.equal(loss.target_kl_coeff, coefficient)
    assert torch.equal(saved["balancer"]["coefficient"], coefficient)  # a copy, not the buffer


# --- other losses, bad input


def test_balances_the_losses_of_torchrl() -> None:
    """The entropy bonus of PPO: the coefficient rises while the entropy is below its target."""
    parameters = nn.Sequential(nn.Linear(3, 4), NormalParamExtractor())
    actor = Sequential(
        TensorDictModule(parameters, in_keys=["observation"], out_keys=["loc", "scale"]),
        ProbabilisticTensorDictModule(
            in_keys=["loc", "scale"],
            out_keys=["action"],
            distribution_class=torch.distributions.Normal,
            distribution_kwargs={"validate_args": False},
            return_log_prob=True,
        ),
    )
    loss = ClipPPOLoss(actor, None, entropy_coeff=0.01)
    balancer = AdaptiveCoefficient(loss, "entropy_coeff", "entropy", 2.0, rate=0.1, limit="lower")
    balancer.step(TensorDict(entropy=torch.tensor(1.0)))
    assert loss.entropy_coeff.item() == pytest.approx(0.01 * math.exp(0.05))


def vjepa_loss(**kwargs: Any) -> VJEPALoss:
    return VJEPALoss(formed(VJEPA, 0.3), **kwargs)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"coefficient": "beta"}, r"coefficient must be one of \[.*'target_kl_coeff'.* got 'beta'"),
        ({"coefficient": "sliced_entropy_coeff"}, "coefficient must be one of"),
        ({"diagnostic": "loss_target_kl"}, "that no coefficient weighs, .* got 'loss_target_kl'"),
        ({"diagnostic": "structural_kl"}, r"one of \[.*'target_kl'.*\] for VJEPALoss"),
        ({"target": 0.0}, "target must be finite and not 0, got 0.0"),
        ({"target": math.nan}, "target must be finite"),
        ({"rate": 0.0}, "rate must be finite and positive, got 0.0"),
        ({"rate": math.inf}, "rate must be finite and positive, got inf"),
        ({"damping": -1.0}, "damping must be finite and at least 0, got -1.0"),
        ({"bounds": (0.0, 1.0)}, "bounds must be finite"),
        ({"bounds": (1.0, 1.0)}, "bounds must be finite"),
        ({"bounds": (1.0, math.inf)}, "bounds must be finite"),
        ({"bounds": (0.1, 1.0)}, r"target_kl_coeff must start within bounds=\(0.1, 1.0\) .* got 0.0099"),
        ({"limit": "both"}, "limit must be 'upper' or 'lower', got 'both'"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    given = {"coefficient": "target_kl_coeff", "diagnostic": "target_kl", "target": 1.0, **arguments}
    with pytest.raises(ValueError, match=message):
        AdaptiveCoefficient(vjepa_loss(), **given)


def test_without_reduction_there_is_nothing_to_follow() -> None:
    with pytest.raises(ValueError, match="diagnostic must be an entry"):
        AdaptiveCoefficient(vjepa_loss(reduction="none"), "target_kl_coeff", "target_kl", 1.0)


def test_a_coefficient_of_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="must start within bounds"):
        AdaptiveCoefficient(vjepa_loss(target_kl_coeff=0.0), "target_kl_coeff", "target_kl", 1.0)


def test_bad_losses_and_states_are_refused() -> None:
    balancer = AdaptiveCoefficient(vjepa_loss(), "target_kl_coeff", "target_kl", 1.0)
    with pytest.raises(KeyError, match="losses must hold 'target_kl', got"):
        balancer.step(TensorDict(loss_nll=torch.tensor(0.0)))
    with pytest.raises(
        ValueError, match=r"'target_kl' must have the shape \(\) of target_kl_coeff, got \(2,\)"
    ):
        balancer.step(TensorDict(target_kl=torch.zeros(2)))
    state = balancer.state_dict()
    with pytest.raises(
        ValueError, match="state_dict must hold \\['coefficient', 'excess', 'rate', 'target'\\], got"
    ):
        balancer.load_state_dict({"target": 1.0})
    with pytest.raises(ValueError, match=r"a coefficient of shape \(\), got \(2,\)"):
        balancer.load_state_dict({**state, "coefficient": torch.zeros(2)})
