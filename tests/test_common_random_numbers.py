"""Common random numbers: every family moves with its noise, and still has its own distribution."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict.nn.distributions import OneHotCategorical as TensorDictOneHot
from tensordict.nn.distributions.truncated_normal import TruncatedNormal as TensorDictTruncated
from torch import Tensor
from torch.distributions import (
    Bernoulli,
    Beta,
    Categorical,
    Cauchy,
    Distribution,
    Independent,
    Laplace,
    LowRankMultivariateNormal,
    MixtureSameFamily,
    MultivariateNormal,
    Normal,
    StudentT,
    TransformedDistribution,
    Uniform,
)
from torch.distributions import OneHotCategorical as TorchOneHot
from torch.distributions.transforms import AffineTransform, TanhTransform
from torchrl.modules import Delta as TorchRLDelta
from torchrl.modules import (
    MaskedCategorical,
    MaskedOneHotCategorical,
    OneHotCategorical,
    OneHotOrdinal,
    Ordinal,
    TanhDelta,
    TanhNormal,
    TruncatedNormal,
)

from torchrl_vjepa.belief import ParticleBelief
from torchrl_vjepa.common_random_numbers import CommonNoise, has_common_noise, sample_common
from torchrl_vjepa.distributions import Delta, diag_gaussian

ROOT = torch.tensor([[1.0, 0.0], [0.7, 0.5]], dtype=torch.float64)


def full(loc: Tensor) -> Distribution:
    return MultivariateNormal(loc, scale_tril=ROOT, validate_args=False)


def low_rank(loc: Tensor) -> Distribution:
    return LowRankMultivariateNormal(
        loc, ROOT[:, :1].expand(*loc.shape, 1), torch.full_like(loc, 0.3), validate_args=False
    )


def mixture(loc: Tensor) -> Distribution:
    parts = diag_gaussian(torch.stack([loc - 1, loc + 2], -2), torch.full((2, 2), 0.3).double())
    logits = torch.tensor([0.5, -0.5], dtype=torch.float64).expand(*loc.shape[:-1], 2)
    return MixtureSameFamily(Categorical(logits=logits), parts, validate_args=False)


def full_mixture(loc: Tensor) -> Distribution:
    parts = MultivariateNormal(torch.stack([loc - 1, loc + 2], -2), scale_tril=ROOT, validate_args=False)
    return MixtureSameFamily(Categorical(torch.ones(*loc.shape[:-1], 2).double()), parts, validate_args=False)


def flow(loc: Tensor) -> Distribution:
    return TransformedDistribution(
        diag_gaussian(loc, torch.full_like(loc, 0.5)), [TanhTransform(), AffineTransform(1.0, 2.0)]
    )


def factor_flow(loc: Tensor) -> Distribution:
    """A transform makes the event dimension: the base is a batch of scalars."""
    return TransformedDistribution(Normal(loc, 0.5), [AffineTransform(1.0, 2.0, event_dim=1)])


def particles(loc: Tensor) -> Distribution:
    random = torch.Generator().manual_seed(3)
    offsets = torch.randn(500, 2, dtype=torch.float64, generator=random)
    weights = torch.rand(500, dtype=torch.float64, generator=random).log().expand(*loc.shape[:-1], 500)
    return ParticleBelief(loc.unsqueeze(-2) + offsets, weights)


FAMILIES: dict[str, Callable[[Tensor], Distribution]] = {
    "diagonal": lambda loc: diag_gaussian(loc, torch.full_like(loc, 0.5)),
    "full": full,
    "low_rank": low_rank,
    "mixture": mixture,
    "full_mixture": full_mixture,
    "flow": flow,
    "factor_flow": factor_flow,
    "particles": particles,
    "laplace": lambda loc: Independent(Laplace(loc, 0.5, validate_args=False), 1),
    "uniform": lambda loc: Independent(Uniform(loc - 1, loc + 1, validate_args=False), 1),
    "cauchy": lambda loc: Independent(Cauchy(loc, 0.5, validate_args=False), 1),
    "tanh_normal": lambda loc: TanhNormal(loc, torch.full_like(loc, 0.5), low=-2.0, high=3.0),
    "truncated": lambda loc: TruncatedNormal(loc, torch.full_like(loc, 0.5), low=-1.0, high=2.0),
    "truncated_tensordict": lambda loc: Independent(
        TensorDictTruncated(loc, torch.full_like(loc, 0.5), -torch.ones_like(loc), 2 * torch.ones_like(loc)),
        1,
    ),
}
every_family = pytest.mark.parametrize("family", FAMILIES.values(), ids=FAMILIES)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@every_family
def test_equal_rows_get_equal_draws_and_samples_differ(family: Callable[[Tensor], Distribution]) -> None:
    before = torch.get_rng_state()
    draws = sample_common(family(torch.zeros(6, 2, 3, 2).double()), generator=generator())
    assert draws.shape == (6, 2, 3, 2)
    assert draws.dtype == torch.float64
    assert (draws == draws[:, :1, :1]).all()
    assert len(draws[:, 0, 0].unique(dim=0)) == 6
    assert (draws[:, 0, 0, 0] != draws[:, 0, 0, 1]).any()  # components have noise of their own
    assert torch.equal(before, torch.get_rng_state())
    again = sample_common(family(torch.zeros(6, 1, 2).double()), generator=generator())
    assert torch.equal(again[:, 0], draws[:, 0, 0]), "one row or many: the same noise"


@every_family
def test_draws_move_with_the_parameters(family: Callable[[Tensor], Distribution]) -> None:
    loc = torch.tensor([[0.0, 0.0], [1e-6, 1e-6]]).double().expand(50, 2, 2)
    draws = sample_common(family(loc), generator=generator())
    assert ((draws[:, 1] - draws[:, 0]).abs() < 1e-5).all()


@every_family
def test_draws_have_the_distribution(family: Callable[[Tensor], Distribution]) -> None:
    """Compared with its own sampler in mean and covariance of a bounded function."""
    num = 20_000
    p = family(torch.tensor([0.3, -0.2]).double().expand(num, 1, 2))
    torch.manual_seed(1)
    values = [torch.tanh(draw).squeeze(1) for draw in (sample_common(p, generator=generator()), p.sample())]
    for moment in (lambda x: x, lambda x: torch.stack([x[:, 0] * x[:, 1], x[:, 0] ** 2], 1)):
        one, two = (moment(x) for x in values)
        error = ((one.var(0) + two.var(0)) / num).sqrt()
        assert ((one.mean(0) - two.mean(0)).abs() < 5 * error).all()


@every_family
def test_gradient_reaches_the_parameters(family: Callable[[Tensor], Distribution]) -> None:
    loc = torch.zeros(4, 3, 2, dtype=torch.float64, requires_grad=True)

    def draw(value: Tensor) -> Tensor:
        return sample_common(family(value), generator=generator())

    assert torch.autograd.gradcheck(draw, loc)


def test_a_point_mass_is_itself() -> None:
    loc = torch.randn(4, 3, 2, requires_grad=True)
    draw = sample_common(Delta(loc), generator=generator())
    assert torch.equal(draw, loc)
    assert draw.requires_grad


def test_other_families_are_drawn_independently() -> None:
    p = Independent(StudentT(torch.full((5, 3, 2), 4.0), validate_args=False), 1, validate_args=False)
    draws = sample_common(p, generator=generator())
    assert draws.shape == (5, 3, 2)
    assert len(draws.flatten(0, 1).unique(dim=0)) == 15
    assert torch.equal(draws, sample_common(p, generator=generator()))


def test_a_family_of_ones_own_can_join() -> None:
    class Shifted(Normal):
        pass

    @sample_common.register(Shifted)
    def _(p: Shifted, *, generator: torch.Generator | None = None, own_dims: int = 0) -> Tensor:
        return p.loc + 100.0

    p = Independent(Shifted(torch.zeros(4, 3, 2), 1.0), 1)
    assert (sample_common(p) == 100.0).all()


def test_without_generator_the_global_state_is_read() -> None:
    p = mixture(torch.zeros(6, 3, 2).double())
    torch.manual_seed(3)
    one = sample_common(p)
    torch.manual_seed(3)
    assert torch.equal(one, sample_common(p))
    assert not torch.equal(one, sample_common(p))


def test_no_batch_beside_the_samples() -> None:
    for family in FAMILIES.values():
        assert sample_common(family(torch.zeros(6, 2).double()), generator=generator()).shape == (6, 2)


def test_the_comparison_of_two_plans_loses_its_noise() -> None:
    """What common random numbers are for: the variance of a difference of costs."""

    def walk(latent: Tensor, action: Tensor) -> Distribution:
        return mixture(latent + action)

    latent = torch.zeros(500, 2, 2).double()
    action = torch.tensor([[0.0, 0.0], [0.1, 0.1]]).double().expand(500, 2, 2)
    common = CommonNoise(walk, generator())(latent, action).mean.square().sum(-1)
    alone = walk(latent, action).sample().square().sum(-1)
    assert (common[:, 0] - common[:, 1]).var() < 0.05 * (alone[:, 0] - alone[:, 1]).var()


MASK = torch.tensor([True, False, True, True])
LISTED = torch.tensor([0, 2, 3])

CHOICES: dict[str, Callable[[Tensor], Distribution]] = {
    "categorical": lambda logits: Categorical(logits=logits),
    "ordinal": Ordinal,
    "one_hot": lambda logits: OneHotCategorical(logits=logits),
    "one_hot_tensordict": lambda logits: TensorDictOneHot(logits=logits),
    "one_hot_torch": lambda logits: TorchOneHot(logits=logits),
    "one_hot_ordinal": OneHotOrdinal,
    "masked": lambda logits: MaskedCategorical(logits=logits, mask=MASK.expand_as(logits)),
    "masked_one_hot": lambda logits: MaskedOneHotCategorical(logits=logits, mask=MASK.expand_as(logits)),
    "listed": lambda logits: MaskedCategorical(logits=logits, indices=LISTED.expand(*logits.shape[:-1], 3)),
    "listed_one_hot": lambda logits: MaskedOneHotCategorical(
        logits=logits, indices=LISTED.expand(*logits.shape[:-1], 3)
    ),
    "bits": lambda logits: Independent(Bernoulli(logits=logits), 1),
}
every_choice = pytest.mark.parametrize("family", CHOICES.values(), ids=CHOICES)


@every_choice
def test_choices_are_common_and_have_their_frequencies(family: Callable[[Tensor], Distribution]) -> None:
    num = 20_000
    logits = torch.tensor([0.5, -0.3, 0.2, -1.0])
    before = torch.get_rng_state()
    p = family(logits.expand(num, 2, 4))
    draws = sample_common(p, generator=generator())
    assert torch.equal(before, torch.get_rng_state())
    torch.manual_seed(0)
    other = family(logits.expand(num, 4)).sample()  # TorchRL's lists of indices know one batch dimension
    assert draws[:, 0].shape == other.shape
    assert draws.dtype == other.dtype
    assert torch.equal(draws[:, 0], draws[:, 1])

    def counted(value: Tensor) -> Tensor:
        return torch.nn.functional.one_hot(value, 4).float() if value.ndim == 1 else value.float()

    one, two = (counted(value) for value in (draws[:, 0], other))
    error = ((one.var(0) + two.var(0)) / num).sqrt()
    assert ((one.mean(0) - two.mean(0)).abs() <= 5 * error).all()
    assert has_common_noise(p)


@every_choice
def test_choices_move_with_their_probabilities(family: Callable[[Tensor], Distribution]) -> None:
    """Of two rows that are nearly alike only few draws differ."""
    logits = torch.tensor([[0.5, -0.3, 0.2, -1.0], [0.51, -0.31, 0.2, -1.01]]).expand(2000, 2, 4)
    draws = sample_common(family(logits), generator=generator()).reshape(2000, 2, -1)
    assert 0 < (draws[:, 0] != draws[:, 1]).any(-1).float().mean() < 0.03


def test_what_has_no_probability_is_never_drawn() -> None:
    probs = torch.tensor([0.0, 0.1, 0.2, 0.3, 0.1, 0.1, 0.1, 0.1, 0.0, 0.0])
    draws = sample_common(Categorical(probs=probs.expand(200_000, 10)), generator=generator())
    assert draws.min() == 1
    assert draws.max() == 7
    # Parallel sums may be rounded to less than the largest number drawn.
    cumsum = Tensor.cumsum
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Tensor, "cumsum", lambda x, dim: 0.999 * cumsum(x, dim))
        patch.setattr(torch, "rand", lambda shape, **kwargs: torch.ones(shape))
        assert (sample_common(Categorical(probs=probs.expand(3, 10))) == 7).all()


def test_points_of_every_house_are_themselves() -> None:
    loc = torch.randn(4, 3, 2)
    assert torch.equal(sample_common(TorchRLDelta(loc)), loc)
    point = TanhDelta(loc, low=-1.0, high=1.0)
    assert torch.equal(sample_common(point), point.mode)


def test_which_families_have_common_noise() -> None:
    assert all(has_common_noise(family(torch.zeros(2, 2).double())) for family in FAMILIES.values())
    concentration = torch.ones(2, 3)
    for p in (StudentT(4 * concentration), Independent(Beta(concentration, concentration), 1)):
        assert not has_common_noise(p)
        assert not has_common_noise(TransformedDistribution(p, [AffineTransform(0.0, 2.0)]))
    parts = Independent(StudentT(torch.ones(2, 3, 2)), 1)
    assert not has_common_noise(MixtureSameFamily(Categorical(torch.ones(2, 3)), parts))
