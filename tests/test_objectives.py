"""JEPALoss and VJEPALoss against loops, torch.distributions and closed forms."""

from __future__ import annotations

import copy
import math
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import Independent, MultivariateNormal, Normal, kl_divergence
from torchrl.objectives import SoftUpdate

from torchrl_vjepa import (
    JEPA,
    VJEPA,
    CollapseWarning,
    DeltaHead,
    DiagGaussianHead,
    JEPALoss,
    Predictor,
    TargetScale,
    VJEPALoss,
    Whitening,
    effective_rank,
    history_encoder,
    linear_encoder,
    mlp_encoder,
)

OBS, LATENT, ACTION = 6, 3, 2
SKIPS = (1, 3)
LOG_2PI = math.log(2 * math.pi)


def make_windows(*batch: int) -> TensorDict:
    return TensorDict(
        observation=torch.randn(*batch, OBS, dtype=torch.float64),
        action=torch.randn(*batch, ACTION, dtype=torch.float64),
        batch_size=batch,
    )


def with_boundaries(windows: TensorDict) -> tuple[TensorDict, np.ndarray, np.ndarray, np.ndarray]:
    """Windows with random ends, starts and padding; the padding holds NaN."""
    done, is_init = torch.rand(windows.shape) < 0.15, torch.rand(windows.shape) < 0.15
    mask = torch.rand(windows.shape) < 0.9
    windows = windows.apply(lambda x: torch.where(mask.unsqueeze(-1), x, math.nan))
    windows["next", "done"], windows["is_init"] = done.unsqueeze(-1), is_init.unsqueeze(-1)
    windows["collector", "mask"] = mask.unsqueeze(-1)
    return windows, done.numpy(), is_init.numpy(), mask.numpy()


def make_model(cls: type[JEPA] = VJEPA, *, std: float | None = None, **kwargs: Any) -> Any:
    """A double-precision model; ``std`` fixes the scale of the target (1e-9: a point mass)."""
    if std is not None:
        scale = TargetScale(LATENT, kind="constant", init_std=std, log_var_range=(-80.0, 16.0))
        kwargs["target_scale"] = scale
    head = DeltaHead() if cls is JEPA else kwargs.pop("head", None)
    predictor = Predictor(LATENT, ACTION, head=head, skips=SKIPS)
    return cls(kwargs.pop("encoder", None) or linear_encoder(OBS, LATENT), predictor, **kwargs).double()


def associated(loss: Any, eps: float = 0.99) -> Any:
    """The loss with target parameters that differ from the online ones, as they do in training."""
    SoftUpdate(loss, eps=eps)
    for name, target in loss.named_buffers():
        if name.startswith("target_encoder") and target.is_floating_point():
            target.data.add_(0.1 * torch.randn_like(target))
    return loss


def latents(loss: Any, windows: TensorDict) -> tuple[Tensor, Tensor]:
    """Online and target latents, by hand."""
    clean = torch.nan_to_num(windows["observation"])
    weights = [
        params["module", "network", "weight"] for params in (loss.encoder_params, loss.target_encoder_params)
    ]
    return clean @ weights[0].mT, clean @ weights[1].mT


def predict(loss: Any, latent: Tensor, action: Tensor, skip: int) -> Tensor:
    """Features of the linear trunk of every pair, by hand."""
    length = latent.shape[-2] - skip
    chunks = [torch.nan_to_num(action)[..., k : k + length, :] for k in range(skip)]
    weight = loss.predictor_params["trunks", str(SKIPS.index(skip)), "weight"]
    return torch.cat([latent[..., :length, :], *chunks], -1) @ weight.mT


def total(terms: TensorDict) -> Tensor:
    return sum(value.sum() for key, value in terms.items() if key.startswith("loss_"))


# --- values


def loop_mean(values: list[np.ndarray], done: np.ndarray, is_init: np.ndarray, mask: np.ndarray) -> float:
    """Mean over the pairs that lie in one episode and hold no padding, then over skips; by loops."""
    means = []
    for skip, value in zip(SKIPS, values, strict=True):
        kept = []
        for b in range(done.shape[0]):
            for t in range(done.shape[1] - skip):
                joined = not done[b, t : t + skip].any() and not is_init[b, t + 1 : t + skip + 1].any()
                if joined and mask[b, t : t + skip + 1].all():
                    kept.append(value[b, t])
        means.append(sum(kept) / len(kept))
    return float(np.mean(means))


@pytest.mark.parametrize("cls", [JEPA, VJEPA])
def test_jepa_loss_equals_a_loop(cls: type[JEPA]) -> None:
    loss = associated(JEPALoss(make_model(cls), prediction_coeff=2.5))
    windows, done, is_init, mask = with_boundaries(make_windows(7, 9))
    latent, target = latents(loss, windows)
    errors = [
        (predict(loss, latent, windows["action"], k)[..., :LATENT] - target[:, k:]).square().sum(-1)
        for k in SKIPS
    ]
    errors = [error.detach().numpy() for error in errors]
    terms = loss(windows)
    assert terms["loss_prediction"].item() == pytest.approx(
        2.5 * loop_mean(errors, done, is_init, mask), rel=1e-12
    )
    each = [terms[f"error_skip_{skip}"].item() for skip in SKIPS]
    assert 2.5 * np.mean(each) == pytest.approx(terms["loss_prediction"].item(), rel=1e-12)


@pytest.mark.parametrize("std", [1e-9, 0.7])
def test_vjepa_loss_equals_torch_distributions(std: float) -> None:
    """With std -> 0 the target is its mean; else a sample is drawn, feature by feature."""
    loss = associated(VJEPALoss(make_model(std=std), target_kl_coeff=0.3))
    windows, done, is_init, mask = with_boundaries(make_windows(7, 9))
    latent, target = latents(loss, windows)
    q = Normal(target, torch.full_like(target, std))
    torch.manual_seed(5)
    terms = loss(windows)
    torch.manual_seed(5)
    noise = torch.randn(LATENT, *target.shape[:2], dtype=target.dtype).movedim(0, -1)
    sample = target + std * noise
    nlls = []
    for skip in SKIPS:
        loc, log_var = predict(loss, latent, windows["action"], skip).chunk(2, -1)
        p = Independent(Normal(loc, (0.5 * log_var).exp()), 1)
        nlls.append(-p.log_prob(sample[:, skip:]).detach().numpy())
    expected = loop_mean(nlls, done, is_init, mask)
    assert terms["loss_nll"].item() == pytest.approx(expected, rel=1e-5)  # the soft clamp bends by 1e-7
    assert np.mean([terms[f"nll_skip_{k}"].item() for k in SKIPS]) == pytest.approx(terms["loss_nll"].item())
    kl = kl_divergence(q, Normal(0.0, 1.0)).sum(-1).numpy()[mask].mean()
    assert terms["loss_target_kl"].item() == pytest.approx(0.3 * kl, rel=1e-6)
    assert terms["target_std"].item() == pytest.approx(std, rel=1e-6)


def test_target_is_a_fresh_unbiased_sample() -> None:
    """The mean NLL is the cross-entropy E_q[-log p], whatever way the noise is drawn."""
    loss = associated(VJEPALoss(make_model(std=0.7), reduction="none"))
    windows = make_windows(4000, max(SKIPS) + 1)
    latent, target = latents(loss, windows)
    rows = loss(windows)["loss_nll"].detach()
    assert not torch.equal(rows, loss(windows)["loss_nll"])
    expected = torch.zeros_like(rows)
    for skip in SKIPS:
        loc, log_var = predict(loss, latent, windows["action"], skip).chunk(2, -1)
        energy = ((loc - target[:, skip:]).square() + 0.49) * (-log_var).exp()
        expected[:, :-skip] += 0.5 * (energy + log_var + LOG_2PI).sum(-1).detach() / len(SKIPS)
    gap = (rows - expected).sum(1)
    assert abs(gap.mean()) < 4 * gap.std() / math.sqrt(len(gap))
    assert gap.std() > 0.1


def test_regularisers_equal_closed_forms() -> None:
    coefficients = {"variance_coeff": 2.0, "covariance_coeff": 3.0, "marginal_entropy_coeff": 0.7}
    loss = associated(VJEPALoss(make_model(std=1e-9), **coefficients))
    windows, *_, mask = with_boundaries(make_windows(7, 9))
    kept = latents(loss, windows)[0].detach()[torch.from_numpy(mask)]
    mean, covariance = kept.mean(0), torch.cov(kept.mT, correction=0)
    terms = loss(windows)
    unit = MultivariateNormal(torch.zeros_like(mean), torch.eye(LATENT, dtype=mean.dtype))
    kl = kl_divergence(MultivariateNormal(mean, covariance), unit)
    torch.testing.assert_close(terms["loss_entropy"], 0.7 * kl, rtol=1e-3, atol=1e-4)  # eps=1e-6
    variance = np.maximum(0, 1 - np.sqrt(np.diag(covariance) + 1e-4)).mean()
    assert terms["loss_variance"].item() == pytest.approx(2 * variance, rel=1e-9)
    off = sum(covariance[i, j].item() ** 2 for i in range(LATENT) for j in range(LATENT) if i != j)
    assert terms["loss_covariance"].item() == pytest.approx(3 * off / LATENT, rel=1e-9)
    torch.testing.assert_close(terms["effective_rank"], effective_rank(kept))
    torch.testing.assert_close(terms["latent_std"], kept.std(0, correction=0).mean())
    # Far away and wide: the hinge is shut.
    loss.encoder_params["module", "network", "weight"].data.mul_(100)
    assert loss(windows)["loss_variance"] == 0


def test_regularisers_move_the_online_encoder_alone() -> None:
    """Gradient of the entropy term equals that of the closed form, in the online latents."""
    loss = associated(VJEPALoss(make_model(std=1e-9), marginal_entropy_coeff=0.7, covariance_coeff=0.2))
    windows = make_windows(7, 9)
    weight = loss.encoder_params["module", "network", "weight"]
    terms = loss(windows)
    rows = (windows["observation"] @ weight.mT).reshape(-1, LATENT)
    covariance = torch.cov(rows.mT, correction=0)
    unit = MultivariateNormal(torch.zeros(LATENT).double(), torch.eye(LATENT).double())
    oracle = 0.7 * kl_divergence(MultivariateNormal(rows.mean(0), covariance), unit)
    off_diagonal = covariance - covariance.diag().diag()
    oracle = oracle + 0.2 * off_diagonal.square().sum() / LATENT
    torch.testing.assert_close(
        torch.autograd.grad(terms["loss_entropy"] + terms["loss_covariance"], weight)[0],
        torch.autograd.grad(oracle, weight)[0],
        rtol=1e-3,
        atol=1e-4,
    )


# --- closed-form residual covariance


def test_profile_likelihood() -> None:
    """residual_variance="batch": the NLL at the MLE covariance; its gradient is that of log det / 2."""
    loss = associated(VJEPALoss(make_model(std=1e-9), residual_variance="batch"))
    windows, done, is_init, mask = with_boundaries(make_windows(40, 9))
    parameters = [loss.encoder_params["module", "network", "weight"]]
    parameters += [loss.predictor_params["trunks", str(i), "weight"] for i in range(len(SKIPS))]
    latent, target = latents(loss, windows)
    value, profile = 0.0, torch.zeros((), dtype=torch.float64)
    for skip in SKIPS:
        residual = predict(loss, latent, windows["action"], skip)[..., :LATENT] - target[:, skip:]
        keep = torch.zeros(residual.shape[:2], dtype=torch.bool)
        for b, t in np.ndindex(keep.shape):
            joined = not done[b, t : t + skip].any() and not is_init[b, t + 1 : t + skip + 1].any()
            keep[b, t] = bool(joined and mask[b, t : t + skip + 1].all())
        rows = residual[keep]
        covariance = rows.mT @ rows / len(rows)
        p = MultivariateNormal(torch.zeros(LATENT).double(), covariance.detach())
        value += -p.log_prob(rows.detach()).mean().item() / len(SKIPS)
        profile = profile + 0.5 * torch.logdet(covariance) / len(SKIPS)
    terms = loss(windows)
    assert terms["loss_nll"].item() == pytest.approx(value, rel=1e-4)
    for ours, oracle in zip(
        torch.autograd.grad(terms["loss_nll"], parameters),
        torch.autograd.grad(profile, parameters),
        strict=True,
    ):
        torch.testing.assert_close(ours, oracle, rtol=1e-4, atol=1e-5)


def test_loss_head_trains_the_head_alone() -> None:
    model = make_model(std=1e-9, head=DiagGaussianHead("constant"))
    loss = associated(VJEPALoss(model, residual_variance="batch"))
    windows = make_windows(7, 9)
    terms = loss(windows)
    latent, target = latents(loss, windows)
    nll = 0.0
    for skip in SKIPS:  # constants start at zero: unit variance
        residual = predict(loss, latent, windows["action"], skip) - target[:, skip:]
        nll += 0.5 * (residual.square() + LOG_2PI).sum(-1).mean().item() / len(SKIPS)
    assert terms["loss_head"].item() == pytest.approx(nll, rel=1e-6)
    assert np.mean([terms[f"nll_skip_{k}"].item() for k in SKIPS]) == pytest.approx(nll, rel=1e-6)

    weight = loss.encoder_params["module", "network", "weight"]
    constants = loss.predictor_params["constants"]
    (alone,) = torch.autograd.grad(terms["loss_head"], weight, retain_graph=True, allow_unused=True)
    assert alone is None or not alone.any()
    with_head = torch.autograd.grad(total(terms), weight, retain_graph=True)[0]
    without = torch.autograd.grad(terms["loss_nll"], weight, retain_graph=True)[0]
    torch.testing.assert_close(with_head, without, rtol=0, atol=0)
    (by_nll,) = torch.autograd.grad(terms["loss_nll"], constants, retain_graph=True, allow_unused=True)
    assert by_nll is None or not by_nll.any()
    assert torch.autograd.grad(terms["loss_head"], constants)[0].abs().min() > 0


@pytest.mark.parametrize("residual_variance", ["head", "batch"])
def test_mutual_information_of_a_linear_gaussian_system(residual_variance: str) -> None:
    """z' = a z + w stationary: I = -1/2 log(1 - a^2) per dimension, at the true model."""
    a = torch.tensor([0.9, 0.5, 0.0], dtype=torch.float64)
    num = 40_000
    start = torch.randn(num, LATENT, dtype=torch.float64)
    following = a * start + (1 - a**2).sqrt() * torch.randn_like(start)
    model = VJEPA(
        linear_encoder(LATENT, LATENT),
        Predictor(LATENT, head=DiagGaussianHead("constant")),
        target_scale=TargetScale(LATENT, kind="constant", init_std=1e-6, log_var_range=(-40.0, 1.0)),
    ).double()
    with torch.no_grad():
        model.encoder.module.network.weight.copy_(torch.eye(LATENT))
        model.predictor.trunks[0].weight.copy_(a.diag())
        model.predictor.constants.copy_((1 - a**2).log())
    loss = VJEPALoss(model, residual_variance=residual_variance)
    SoftUpdate(loss, eps=0.99)
    windows = TensorDict(observation=torch.stack([start, following], 1), batch_size=(num, 2))
    exact = -0.5 * (1 - a**2).log().sum().item()
    # Entropy and NLL are each half a mean of chi-squares per dimension.
    error = math.sqrt(LATENT / num)
    assert abs(loss(windows)["mutual_information"].item() - exact) < 4 * error


# --- target encoder


def test_targets_get_no_gradient_and_the_online_encoder_does() -> None:
    loss = associated(VJEPALoss(make_model(), marginal_entropy_coeff=0.1))
    targets = {n: b.clone() for n, b in loss.named_buffers() if n.startswith("target_encoder")}
    assert targets
    assert not any(b.requires_grad for n, b in loss.named_buffers() if n in targets)
    with torch.no_grad():  # a scale of exactly 1 is the optimum of the KL
        for scale in loss.scale_params.values(True, True):
            scale.add_(0.1)
    total(loss(make_windows(4, 6))).backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in loss.parameters() if p.numel())
    assert not any(n.startswith("target_") for n, _ in loss.named_parameters())
    assert all(torch.equal(b, targets[n]) for n, b in loss.named_buffers() if n in targets)


def test_targets_get_no_gradient_through_the_target_distribution() -> None:
    """The encoder's gradient is that of the context alone: equal to that with a constant target."""
    loss = associated(VJEPALoss(make_model(std=1e-9), target_kl_coeff=1.0))
    windows = make_windows(4, 6)
    weight = loss.encoder_params["module", "network", "weight"]
    latent, target = latents(loss, windows)
    nll = torch.zeros((), dtype=torch.float64)
    for skip in SKIPS:
        loc, log_var = predict(loss, latent, windows["action"], skip).chunk(2, -1)
        p = Independent(Normal(loc, (0.5 * log_var).exp()), 1)
        nll = nll - p.log_prob(target[:, skip:].detach()).mean() / len(SKIPS)
    torch.testing.assert_close(
        torch.autograd.grad(total(loss(windows)), weight)[0],
        torch.autograd.grad(nll, weight)[0],
        rtol=1e-5,
        atol=1e-6,
    )


def test_whitening_of_the_target_follows_the_online_encoder() -> None:
    def build(whitening: Whitening) -> Any:
        torch.manual_seed(1)
        encoder = mlp_encoder(OBS, LATENT, num_cells=[8], whitening=whitening)
        return associated(JEPALoss(make_model(JEPA, encoder=encoder)))

    late, early = Whitening(OBS), Whitening(OBS)
    windows = make_windows(30, 6)
    windows["observation"] = windows["observation"] * torch.linspace(1, 4, OBS).double() + 5
    early.update(windows["observation"])
    reference = build(early)(windows)["loss_prediction"]
    loss = build(late)
    before = loss(windows)["loss_prediction"]
    late.update(windows["observation"])
    assert not torch.isclose(before, reference, rtol=0.1)
    torch.testing.assert_close(loss(windows)["loss_prediction"], reference)


@pytest.mark.parametrize(
    ("option", "by_kl", "by_nll"), [("kl", True, False), ("both", True, True), ("none", False, False)]
)
@pytest.mark.parametrize("kind", ["learned", "linear"])
def test_target_scale_gradient(option: str, by_kl: bool, by_nll: bool, kind: str) -> None:
    scale = TargetScale(LATENT, OBS, kind=kind, init_std=0.5)
    loss = associated(VJEPALoss(make_model(target_scale=scale), target_scale_gradient=option))
    terms = loss(make_windows(4, 6))
    (parameter,) = scale.parameters()
    for key, expected in (("loss_target_kl", by_kl), ("loss_nll", by_nll)):
        gradient = None
        if terms[key].requires_grad:
            (gradient,) = torch.autograd.grad(terms[key], parameter, retain_graph=True, allow_unused=True)
        assert (gradient is not None and bool(gradient.any())) == expected
    encoder = [p for n, p in loss.named_parameters() if n.startswith("encoder")]
    if terms["loss_target_kl"].requires_grad:  # the mean of q is the target encoder's
        gradients = torch.autograd.grad(terms["loss_target_kl"], encoder, allow_unused=True)
        assert all(g is None or not g.any() for g in gradients)


def test_get_model_of_a_copy() -> None:
    """A loss that was copied (or unpickled) and trained hands back what it trained."""
    clone = copy.deepcopy(associated(VJEPALoss(make_model())))
    with torch.no_grad():
        for parameter in clone.parameters():
            parameter.fill_(0.25)
    assert all((parameter == 0.25).all() for parameter in clone.get_model().parameters())


# --- collapse


def test_collapse_warns_once_and_names_the_rank() -> None:
    model = make_model(JEPA)
    with torch.no_grad():
        model.encoder.module.network.weight[1:] = 0
    loss = associated(JEPALoss(model))
    windows = make_windows(6, 5)
    with pytest.warns(CollapseWarning, match=r"effective rank 1\.00 of 3 is under collapse_rank=1\.2"):
        loss(windows)
    for _ in range(2 * loss.collapse_interval):
        loss(windows)  # warnings are errors

    several = JEPALoss([make_model(JEPA), model])
    SoftUpdate(several, eps=0.99)
    with pytest.warns(CollapseWarning, match=r"\(model 1\)"):
        several(windows)


@pytest.mark.parametrize("quiet", ["collapse_rank", "eval", "full rank"])
def test_collapse_does_not_warn(quiet: str) -> None:
    model = make_model(JEPA)
    if quiet != "full rank":
        with torch.no_grad():
            model.encoder.module.network.weight[1:] = 0
    loss = associated(JEPALoss(model, collapse_rank=0.0 if quiet == "collapse_rank" else 1.2))
    loss.train(quiet != "eval")
    windows = make_windows(6, 5)
    for _ in range(2 * loss.collapse_interval):
        loss(windows)


def test_a_run_that_collapses_says_so() -> None:
    """Squared error without a regulariser: one slow direction among noise is all that survives."""
    windows = make_windows(60, 6).float()
    windows["observation"][..., 0] = 2 * torch.randn(60, 1)
    loss = JEPALoss(JEPA(linear_encoder(OBS, LATENT), Predictor(LATENT, ACTION, head=DeltaHead())))
    updater = SoftUpdate(loss, eps=0.9)
    optimizer = torch.optim.AdamW(loss.parameters(), 2e-2, weight_decay=1.0)
    ranks = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(200):
            terms = loss(windows)
            ranks.append(terms["effective_rank"].item())
            total(terms).backward()
            optimizer.step()
            optimizer.zero_grad()
            updater.step()
    assert ranks[0] > 1.5
    assert ranks[-1] < 1.1
    assert [w.category for w in caught].count(CollapseWarning) == 1


# --- memory


@pytest.mark.parametrize(("cls", "several"), [(JEPA, False), (VJEPA, False), (VJEPA, True)])
def test_history_encoder(cls: type[JEPA], several: bool) -> None:
    """Windows with an episode's start inside: the latents are those of acting step by step."""
    encoder = history_encoder(OBS, LATENT, hidden_dim=5).double()
    model = make_model(cls, encoder=encoder, **({"std": 1e-9} if cls is VJEPA else {}))
    loss = (JEPALoss if cls is JEPA else VJEPALoss)([model] if several else model)
    SoftUpdate(loss, eps=0.99)
    windows = make_windows(4, 7)
    windows["is_init"] = torch.zeros(4, 7, 1, dtype=torch.bool)
    windows["is_init"][:, 0] = windows["is_init"][1:3, 3] = True
    terms = loss(windows)

    steps, state = [], None
    for t in range(7):
        step = windows[:, t].clone()
        if state is not None:
            step["history"] = state
        encoder(step)
        steps.append(step["latent"])
        state = step["next", "history"]
    latent = torch.stack(steps, 1)
    means = []
    for skip in SKIPS:
        features = predict(loss, latent, windows["action"], skip)
        loc, log_var = (features, None) if cls is JEPA else features.chunk(2, -1)
        square = (loc - latent[:, skip:]).square()
        if log_var is not None:
            square = 0.5 * (square * (-log_var).exp() + log_var + LOG_2PI)
        inside = [(b, t) for b, t in np.ndindex(4, 7 - skip) if b in (0, 3) or not t < 3 <= t + skip]
        means.append(torch.stack([square[b, t].sum() for b, t in inside]).mean())
    key = "loss_prediction" if cls is JEPA else "loss_nll"
    torch.testing.assert_close(terms[key].sum(), torch.stack(means).mean(), rtol=1e-5, atol=1e-8)
    total(terms).backward()
    parameters = [p for n, p in loss.named_parameters() if n.startswith("encoder_params")]
    assert all(p.grad is not None and p.grad.any() for p in parameters)


def test_the_scale_may_read_another_entry_than_the_encoder() -> None:
    predictor = Predictor(LATENT, ACTION, skips=SKIPS)
    scale = TargetScale(LATENT, 2, kind="linear")
    model = VJEPA(linear_encoder(OBS, LATENT), predictor, target_scale=scale, observation_key="light")
    loss = associated(VJEPALoss(model.double()))
    windows = make_windows(4, 9)
    with pytest.raises(KeyError, match="light"):
        loss(windows)
    windows["light"] = torch.randn(4, 9, 2, dtype=torch.float64)
    assert "light" in loss.in_keys
    expected = (0.5 * (windows["light"] @ scale.linear.weight.mT)).exp().square().mean((0, 1)).sqrt().mean()
    torch.testing.assert_close(loss(windows)["target_std"], expected.detach(), rtol=1e-5, atol=1e-6)
