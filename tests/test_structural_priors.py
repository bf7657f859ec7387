"""Structural priors in training: divergences by hand, any density in BJEPALoss, slow and sparse latents."""

from __future__ import annotations

import copy
import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.distributions import Laplace, Normal
from torchrl.objectives import SoftUpdate

from torchrl_vjepa import (
    BJEPA,
    Ball,
    BJEPALoss,
    Density,
    DiagGaussianHead,
    EnergyPrior,
    GaussianFactor,
    GaussianPrior,
    GoalPrior,
    MixtureHead,
    Predictor,
    Prior,
    ProbedPrior,
    ProductPrior,
    RegionPrior,
    SlownessPrior,
    SparsityPrior,
    diag_gaussian,
    full_gaussian,
    kl_divergence,
    linear_encoder,
    monte_carlo_kl,
)

OBS, D = 6, 3
DTYPE = torch.float64


def size(latent: Tensor) -> Tensor:
    return 0.5 * latent.square().sum(-1)


PRIORS = {
    "slowness": lambda: SlownessPrior(D, 0.3),
    "sparsity": lambda: SparsityPrior(D, scale=0.5),
    "student": lambda: SparsityPrior(D, scale=0.5, degrees=3.0),
    "energy": lambda: EnergyPrior(size, latent_dim=D),
    "region": lambda: RegionPrior(Ball(torch.zeros(D), 1.0), "in", sharpness=3.0),
    "probed": lambda: ProbedPrior(GaussianPrior(2), torch.eye(2, D)),
    "bound": lambda: GoalPrior(std=0.5).bind(torch.ones(D)),
    "product": lambda: ProductPrior(SlownessPrior(D, 0.3), GaussianPrior(D), SparsityPrior(D)),
    "learned product": lambda: ProductPrior(GaussianPrior(D, learnable=True), SparsityPrior(D)),
}
EVERY = pytest.mark.parametrize("name", PRIORS)


def model_with(prior: nn.Module, head: Any = None) -> BJEPA:
    predictor = Predictor(D, skips=(1, 2), head=head or DiagGaussianHead())
    return BJEPA(linear_encoder(OBS, D), predictor, structural_prior=prior).double()


def windows(*batch: int) -> TensorDict:
    return TensorDict(observation=torch.randn(*batch, OBS, dtype=DTYPE), batch_size=batch)


def loss_of(model: Any, **kwargs: Any) -> BJEPALoss:
    loss = BJEPALoss(model, **kwargs)
    SoftUpdate(loss, eps=0.9)
    return loss


def total(terms: TensorDict) -> Tensor:
    return sum(value.sum() for key, value in terms.items() if key.startswith("loss_"))


# --- divergences


def test_slowness_divergence_by_hand() -> None:
    context, mean, scale = torch.randn(3, 5, D).unbind()
    scale, std = scale.abs() + 0.1, torch.tensor([0.1, 1.0, 2.0])
    got = kl_divergence(diag_gaussian(mean, scale), SlownessPrior(D, std)(context))
    ratio = (scale / std).square()
    expected = 0.5 * (((mean - context) / std).square() + ratio - 1 - ratio.log()).sum(-1)
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-4)


def test_sparsity_divergence_by_hand() -> None:
    """Numerically integrated, per dimension."""
    mean, scale = torch.tensor([0.0, 1.0, -3.0], dtype=DTYPE), torch.tensor([0.2, 1.0, 0.5], dtype=DTYPE)
    prior = SparsityPrior(D, scale=torch.tensor([0.5, 1.0, 2.0])).double()
    got = kl_divergence(diag_gaussian(mean, scale), prior())
    x = torch.linspace(-12, 12, 200001, dtype=DTYPE).unsqueeze(-1)
    p, q = Normal(mean, scale), Laplace(torch.zeros(D, dtype=DTYPE), prior.scale)
    density = p.log_prob(x)
    values = density.exp() * (density - q.log_prob(x))
    torch.testing.assert_close(got, torch.trapezoid(values, x, dim=0).sum(), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("kind", ["factor", "base", "energy", "both", "flat"])
def test_divergence_from_what_is_not_normalised(kind: str, full: bool) -> None:
    """-H(p) - E_p log q: against a large sample, and exactly where there is a closed form."""
    generator = torch.Generator().manual_seed(0)
    mean = torch.randn(4, D, generator=generator, dtype=DTYPE)
    root = torch.randn(D, D, generator=generator, dtype=DTYPE).tril(-1) + torch.eye(D, dtype=DTYPE)
    p = full_gaussian(mean, root) if full else diag_gaussian(mean, torch.full((D,), 0.7, dtype=DTYPE))
    row = torch.tensor([[1.0, -2.0, 0.5]], dtype=DTYPE)
    factor = GaussianFactor(row.mT @ row, row.squeeze(0), 0.7)
    base = diag_gaussian(torch.ones(D, dtype=DTYPE), torch.ones(1, dtype=DTYPE))
    q: Any = {
        "factor": factor,
        "base": Density(base=base),
        "energy": Density(lambda z: z.abs().sum(-1)),
        "both": Density(lambda z: z.abs().sum(-1), factor),
        "flat": Density(),
    }[kind]
    closed = kind in ("factor", "base", "flat")
    got = kl_divergence(p, q, num_samples=None if closed else 20000, generator=generator)
    estimate = monte_carlo_kl(p, q, 20000, generator=generator)
    assert ((got - estimate.value).abs() < 6 * estimate.standard_error + 1e-9).all()
    if kind == "base":
        torch.testing.assert_close(got, kl_divergence(p, base))
    if kind == "flat":
        torch.testing.assert_close(got, -p.entropy().expand(4))
    if not closed:
        with pytest.raises(TypeError, match="num_samples"):
            kl_divergence(p, q)


# --- in the loss


@EVERY
@pytest.mark.parametrize("head", ["diagonal", "mixture"])
def test_any_prior_trains_a_model(name: str, head: str) -> None:
    """The term is finite and moves encoder and predictor."""
    model = model_with(PRIORS[name](), MixtureHead(2) if head == "mixture" else None)
    loss = loss_of(model, num_kl_samples=4)
    terms = loss(windows(4, 6))
    terms["loss_structural_kl"].backward()
    for part in (model.encoder, model.predictor):
        gradients = [p.grad for p in part.parameters() if p.grad is not None]
        assert any(g.any() for g in gradients)
        assert all(g.isfinite().all() for g in gradients)


@EVERY
def test_a_list_equals_one_by_one(name: str) -> None:
    models = [model_with(PRIORS[name]()) for _ in range(3)]
    batch = windows(4, 6)
    several = loss_of(copy.deepcopy(models))
    torch.manual_seed(3)
    terms = several(batch)
    total(terms).backward()
    exact = name in ("slowness", "sparsity", "probed", "bound")
    for i, model in enumerate(models):
        loss = loss_of(model)
        torch.manual_seed(3)
        alone = loss(batch)
        for key, value in terms.items():
            if exact or "structural" not in key:
                torch.testing.assert_close(value[i], alone[key])
        if exact:
            total(alone).backward()
            gradients = dict(several.named_parameters())
            for key, parameter in loss.named_parameters():
                if parameter.numel() and parameter.grad is not None:
                    torch.testing.assert_close(gradients[key].grad[i], parameter.grad)  # type: ignore[index]


@pytest.mark.parametrize("detach", [False, True])
def test_slowness_meets_the_context_of_each_pair(detach: bool) -> None:
    """By a loop over pairs; with the stated gradient to the context."""
    model = model_with(SlownessPrior(D, 0.3, detach_context=detach))
    batch = windows(3, 5)
    loss = loss_of(model, structural_kl_coeff=1.0)
    got = loss(batch)["loss_structural_kl"]
    weight = model.encoder.module.network.weight
    latent = batch["observation"] @ weight.mT
    values = []
    for skip in (1, 2):
        of_skip = []
        for b in range(3):
            for t in range(5 - skip):
                context = latent[b, t]
                p = model.predictor.dist(context, skip=skip)
                anchor = context.detach() if detach else context
                ratio = (p.stddev / 0.3).square()
                of_skip.append(0.5 * (((p.mean - anchor) / 0.3).square() + ratio - 1 - ratio.log()).sum())
        values.append(torch.stack(of_skip).mean())
    expected = torch.stack(values).mean()
    torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-5)
    ours, theirs = (torch.autograd.grad(x, weight, retain_graph=True)[0] for x in (got, expected))
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5)


def test_a_prior_that_is_a_plain_module() -> None:
    class Plain(nn.Module):
        def forward(self) -> Any:
            return diag_gaussian(torch.zeros(D, dtype=DTYPE), torch.ones(D, dtype=DTYPE))

    batch = windows(3, 5)
    plain = model_with(Plain())
    fixed = model_with(GaussianPrior(D))
    fixed.load_state_dict(plain.state_dict(), strict=False)
    torch.testing.assert_close(loss_of(plain)(batch)["structural_kl"], loss_of(fixed)(batch)["structural_kl"])


def test_other_tasks_are_refused() -> None:
    with pytest.raises(ValueError, match=r"structural_prior must read the context latent 'latent' or not"):
        BJEPALoss(model_with(GoalPrior(std=1.0)))


def trained(prior: Prior, gamma: float) -> tuple[Tensor, Tensor]:
    """Latents and predicted means ``(T, D)``, after training on three fast sources and three slow ones.

    The fast ones (a rotation and a change of sign) can be predicted, the slow ones are autoregressions.
    """
    torch.manual_seed(0)
    steps = torch.arange(600, dtype=DTYPE)
    turn = math.sqrt(2) * torch.stack([(1.3 * steps).cos(), (1.3 * steps).sin()], -1)
    slow = [torch.randn(3, dtype=DTYPE)]
    for _ in range(599):
        slow.append(0.95 * slow[-1] + math.sqrt(1 - 0.95**2) * torch.randn(3, dtype=DTYPE))
    sources = torch.cat([turn, (-1.0) ** steps.unsqueeze(-1), torch.stack(slow)], -1)
    data = sources @ torch.linalg.qr(torch.randn(OBS, OBS, dtype=DTYPE)).Q
    data = data + 0.1 * torch.randn(600, OBS, dtype=DTYPE)
    model = model_with(prior)
    loss = loss_of(model, structural_kl_coeff=gamma, marginal_entropy_coeff=1.0, collapse_rank=0.0)
    optimizer = torch.optim.Adam(loss.parameters(), lr=2e-2)
    updater = SoftUpdate(loss, eps=0.9)
    batch = TensorDict(observation=data.unflatten(0, (40, 15)), batch_size=(40, 15))
    loss.select_out_keys(*(key for key in loss.out_keys if key.startswith("loss_")))
    for _ in range(150):
        optimizer.zero_grad()
        total(loss(batch)).backward()
        optimizer.step()
        updater.step()
    with torch.no_grad():
        latent = data @ model.encoder.module.network.weight.mT
        return latent, model.predictor.dist(latent).mean


def test_slowness_makes_latents_slower() -> None:
    """The mean squared step, for latents of unit variance."""
    speed = {}
    with torch.random.fork_rng():
        for gamma in (0.0, 10.0):
            latent, _ = trained(SlownessPrior(D, 1.0), gamma)
            speed[gamma] = (latent.diff(dim=0).square().mean(0) / latent.var(0)).mean().item()
    assert speed[10.0] < 0.5 * speed[0.0], speed


def test_sparsity_makes_predictions_sparser() -> None:
    """The share of predicted coordinates near zero, in units of the prior."""
    share = {}
    with torch.random.fork_rng():
        for gamma in (0.0, 1.0):
            _, mean = trained(SparsityPrior(D, scale=0.1), gamma)
            share[gamma] = (mean.abs() < 0.1).double().mean().item()
    assert share[1.0] > 2 * share[0.0], share


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: SlownessPrior(D, 0.0), "std must be positive"),
        (lambda: SlownessPrior(D, torch.ones(2)), r"std must be a finite number or a tensor of shape \(3,\)"),
        (lambda: SlownessPrior(D, 1.0)(torch.zeros(4, 2)), r"task must be the context, of shape \(\*B, 3\)"),
        (lambda: SparsityPrior(D, scale=-1.0), "scale must be positive"),
        (lambda: SparsityPrior(D, degrees=0.0), "degrees must be positive and finite, got 0.0"),
        (lambda: SparsityPrior(D, degrees=math.inf), "degrees must be positive and finite, got inf"),
    ],
)
def test_bad_arguments_are_refused(build: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build()
