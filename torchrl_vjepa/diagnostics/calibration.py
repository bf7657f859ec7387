"""Calibration of a model by skip and by horizon, and its repair: one temperature for every skip."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.distributions import Distribution

from torchrl_vjepa.diagnostics.beliefs import (
    Belief,
    checked_target,
    gaussian_marginals,
    masked_mean,
)
from torchrl_vjepa.diagnostics.intervals import (
    LEVELS,
    check_level,
    credible_interval,
    pit_histogram,
    probability_integral_transform,
    reliability_of,
    squared_mahalanobis,
)
from torchrl_vjepa.diagnostics.scores import crps, energy_score
from torchrl_vjepa.distributions import Delta
from torchrl_vjepa.models import LatentModel
from torchrl_vjepa.predictor import Predictor
from torchrl_vjepa.windows import action_chunks, pair_mask, read, step_mask

__all__ = ["Calibration", "calibration_by_horizon", "calibration_by_skip", "recalibrate"]

_MASK_KEYS: tuple[NestedKey, ...] = (("collector", "mask"), "shifted_valid")
# A temperature is looked for between e^-7 and e^7.
_LOG_RANGE = 7.0


class Calibration(NamedTuple):
    r"""How calibrated beliefs are, one row for every number of steps ahead.

    Attributes:
        steps: the :math:`S` numbers of steps ahead: skips, or horizons.
        levels: levels of the credible regions, shape ``(L,)``.
        coverage: fraction of the targets inside, shape ``(S, L)``; equal to ``levels`` if calibrated.
        pit_density: histogram of the probability integral transform, shape ``(S, num_bins)``; 1 if
            calibrated.
        crps: mean over targets and dimensions, shape ``(S,)``, in units of the latent.
        energy_score: mean over targets, shape ``(S,)``, in units of the latent.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import diag_gaussian
        >>> target = torch.randn(500, 2, 3, generator=torch.Generator().manual_seed(0))
        >>> table = calibration_by_horizon(diag_gaussian(torch.zeros(500, 2, 3), torch.ones(3)), target)
        >>> table.steps, bool(table.error.max() < 0.03)
        ((1, 2), True)
    """

    steps: tuple[int, ...]
    levels: Tensor
    coverage: Tensor
    pit_density: Tensor
    crps: Tensor
    energy_score: Tensor

    @property
    def error(self) -> Tensor:
        """Mean over levels of the distance between coverage and level, shape ``(S,)``."""
        return (self.coverage - self.levels).abs().mean(-1)


def calibration_by_horizon(
    p: Belief,
    target: Tensor,
    *,
    mask: Tensor | None = None,
    levels: Sequence[float] = LEVELS,
    num_bins: int = 10,
    joint: bool = False,
    num_samples: int = 64,
    generator: torch.Generator | None = None,
) -> Calibration:
    """Calibration of multi-step beliefs, for each horizon.

    Args:
        p: beliefs about ``1, ..., H`` steps ahead: a distribution with batch ``(*B, H)`` and event
            ``(D,)``, or samples ``(M, *B, H, D)``, as :func:`~torchrl_vjepa.belief.rollout` draws them.
        target: what came true, shape ``(*B, H, D)``.
        mask: boolean, ``(*B, H)`` or ``(*B, H, 1)``; ``False`` marks a target that does not count.
        levels: levels of the credible regions, each in (0, 1).
        num_bins: bins of the histogram.
        joint: regions of the whole vector instead of intervals of its dimensions.
        num_samples: samples, for distributions that are not Gaussian (and for the energy score).
        generator: source of randomness for them.

    Returns:
        One row for each horizon.

    Raises:
        TypeError: if the target is not floating point or the mask not boolean.
        ValueError: if a level or shape does not fit, a value that counts is NaN, or a horizon has no
            target that counts.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import rollout
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> def walk(latent, action):
        ...     return diag_gaussian(latent, torch.ones_like(latent))
        >>> generator = torch.Generator().manual_seed(0)
        >>> paths = torch.randn(300, 5, 1, generator=generator).cumsum(1)
        >>> start, actions = torch.zeros(300, 1), torch.zeros(300, 5, 0)
        >>> p = rollout(walk, start, actions, "sample", num_samples=100, generator=generator)
        >>> calibration_by_horizon(p, paths, levels=[0.9], generator=generator).coverage.shape
        torch.Size([5, 1])
    """
    if target.ndim < 2:
        raise ValueError(f"target must have shape (*B, H, D), got {tuple(target.shape)}")
    target, mask = checked_target(p, target, mask)
    checked = _checked_levels(levels, target)
    measured = _measure(p, target, mask, joint, num_samples, generator)
    rows = []
    for h in range(target.shape[-2]):
        pit, marginal, whole = (value[..., h, :] for value in measured)
        counts = None if mask is None else mask[..., h]
        rows.append(_row((pit, marginal, whole), counts, checked, num_bins, joint, f"horizon {h + 1}"))
    return _table(tuple(range(1, len(rows) + 1)), checked, rows)


@torch.no_grad()
def calibration_by_skip(
    model: LatentModel,
    data: TensorDictBase,
    *,
    levels: Sequence[float] = LEVELS,
    num_bins: int = 10,
    joint: bool = False,
    num_samples: int = 64,
    generator: torch.Generator | None = None,
) -> Calibration:
    r"""Calibration of a model's direct predictions, for each of its skips.

    For every skip :math:`\Delta` the belief :math:`p_\phi(Z_{t+\Delta} \mid Z_t, u_{t:t+\Delta-1})` is
    compared with the latent that the model's encoder gives to what was observed. Pairs across the end of
    an episode and padded steps do not count (``("next", "done")``, ``is_init``,
    ``("collector", "mask")``, ``shifted_valid``, where present).

    Args:
        model: a trained model, for instance a :class:`~torchrl_vjepa.VJEPA`.
        data: held-out windows ``(*B, T)``, longer than the largest skip, with the entries that encoder and
            predictor read; not changed.
        levels: levels of the credible regions, each in (0, 1).
        num_bins: bins of the histogram.
        joint: regions of the whole vector instead of intervals of its dimensions.
        num_samples: samples, for distributions that are not Gaussian (and for the energy score).
        generator: source of randomness for them.

    Returns:
        One row for each skip, in the order of ``model.predictor.skips``.

    Raises:
        KeyError: if an entry is missing.
        ValueError: if windows are too short, a level does not fit, a value that counts is NaN, or no pair
            counts for a skip.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_vjepa import VJEPA, Predictor, linear_encoder
        >>> model = VJEPA(linear_encoder(6, 2), Predictor(2, skips=(1, 4)))
        >>> data = TensorDict(observation=torch.randn(3, 9, 6), batch_size=(3, 9))
        >>> table = calibration_by_skip(model, data)
        >>> table.steps, table.crps.shape
        ((1, 4), torch.Size([2]))
    """
    rows = []
    for skip, p, target, mask in _skip_pairs(model, data):
        checked = _checked_levels(levels, target)
        measured = _measure(p, target, mask, joint, num_samples, generator)
        rows.append(_row(measured, mask, checked, num_bins, joint, f"skip {skip}"))
    return _table(model.predictor.skips, checked, rows)


@torch.no_grad()
def recalibrate(
    model: LatentModel,
    data: TensorDictBase,
    *,
    method: Literal["likelihood", "coverage"] = "likelihood",
    level: float = 0.9,
    num_samples: int = 1000,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Fit one temperature for each skip on held-out data and store it in the predictor.

    The temperature :math:`\tau_\Delta` multiplies every deviation from the predicted mean
    (:func:`~torchrl_vjepa.temperature.temper`), which itself stays. ``"likelihood"`` maximises the
    held-out likelihood; for Gaussians that is

    .. math::
        \tau_\Delta^2 = \frac{1}{D}\, \mathbb E\big[(z - \mu)^\top \Sigma^{-1} (z - \mu)\big]

    ``"coverage"`` makes the central intervals of ``level`` hold just this fraction of the held-out
    latents, whatever the tails. The result is a buffer of the predictor: it is saved with the model, moves
    with it, and acts in every use of ``predictor.dist`` (losses, planners, fusion with a prior). A second
    call refines what the first has set; ``predictor.set_temperature(None)`` takes it away. A loss that
    exists already has its own copy of the predictor's structure: build it anew to train on.

    Args:
        model: a trained model; its predictor's ``temperature`` is set.
        data: held-out windows ``(*B, T)``, longer than the largest skip; masks are those of
            :func:`calibration_by_skip`.
        method: what is fitted.
        level: level of the intervals for ``"coverage"``, in (0, 1).
        num_samples: samples for ``"coverage"``, for distributions that are not Gaussian.
        generator: source of randomness for them.

    Returns:
        The temperatures, shape ``(num_skips,)``.

    Raises:
        KeyError: if an entry is missing.
        TypeError: if the predictor is no :class:`~torchrl_vjepa.Predictor`.
        ValueError: if the predictions are points, which no temperature widens; the method is unknown; or
            the data are too short, NaN where they count, without a pair that counts, or predicted exactly.
            The model is unchanged then.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_vjepa import VJEPA, Predictor, linear_encoder
        >>> model = VJEPA(linear_encoder(6, 2), Predictor(2, skips=(1, 4)))
        >>> data = TensorDict(observation=torch.randn(3, 50, 6), batch_size=(3, 50))
        >>> temperature = recalibrate(model, data)
        >>> torch.equal(model.state_dict()["predictor.temperature"], temperature)
        True
    """
    if method not in ("likelihood", "coverage"):
        raise ValueError(f"method must be 'likelihood' or 'coverage', got {method!r}")
    level = check_level(level)
    predictor = model.predictor
    if not isinstance(predictor, Predictor):
        raise TypeError(f"model must have a Predictor to calibrate, got {type(predictor).__name__}")
    factors = []
    for skip, p, target, mask in _skip_pairs(model, data):
        if isinstance(p, Delta):
            raise ValueError(
                f"model must predict distributions, but {type(predictor.head).__name__} predicts points; use "
                "DiagGaussianHead, for instance"
            )
        target, mask = checked_target(p, target, mask)
        if method == "coverage":
            factor = _covering_factor(p, target, mask, level, num_samples, generator)
        else:
            factor = _likeliest_factor(p, target, mask)
        if not 0 < factor < math.inf:
            raise ValueError(
                "data must have prediction errors whose scale is positive and finite, got a temperature of "
                f"{factor} for skip {skip}: no pair counts, all are predicted exactly, or the scale is out "
                "of reach"
            )
        factors.append(factor)
    before = 1.0 if predictor.temperature is None else predictor.temperature.cpu()
    predictor.set_temperature(before * torch.tensor(factors, dtype=torch.float64))
    # Set just now, and never None.
    return predictor.get_buffer("temperature").clone()


def _likeliest_factor(p: Distribution, target: Tensor, mask: Tensor | None) -> float:
    if gaussian_marginals(p) is not None:
        return (masked_mean(squared_mahalanobis(p, target), mask) / target.shape[-1]).sqrt().item()
    mean = p.mean
    if not mean.isfinite().all():
        return math.nan

    def score(log_factor: float) -> float:
        value = p.log_prob(mean + (target - mean) * math.exp(-log_factor))
        return masked_mean(value, mask).item() - target.shape[-1] * log_factor

    # Not concave for mixtures: a grid first.
    step = 0.25
    count = round(2 * _LOG_RANGE / step) + 1
    best = max((step * i - _LOG_RANGE for i in range(count)), key=score)
    return math.inf if abs(best) == _LOG_RANGE else math.exp(_golden(score, best - step, best + step))


def _golden(score: Callable[[float], float], low: float, high: float) -> float:
    """Where a function with one maximum in ``(low, high)`` has it, by golden section."""
    ratio = (math.sqrt(5) - 1) / 2
    left, right = high - ratio * (high - low), low + ratio * (high - low)
    at_left, at_right = score(left), score(right)
    while high - low > 1e-5:
        if at_left >= at_right:
            high, right, at_right = right, left, at_left
            left = high - ratio * (high - low)
            at_left = score(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + ratio * (high - low)
            at_right = score(right)
    return (low + high) / 2


def _covering_factor(
    p: Distribution,
    target: Tensor,
    mask: Tensor | None,
    level: float,
    num_samples: int,
    generator: torch.Generator | None,
) -> float:
    """The factor at which the intervals hold a fraction ``level``: each target has one that reaches it."""
    lower, upper = credible_interval(p, level, num_samples=num_samples, generator=generator)
    error = target - p.mean
    reach = torch.where(error >= 0, upper - p.mean, p.mean - lower)
    needed = torch.where(reach > 0, error.abs() / reach, torch.inf)
    needed = needed.reshape(-1) if mask is None else needed[mask].reshape(-1)
    if not needed.numel():
        return math.nan
    # The quantile of order statistics, as in credible_interval; torch.quantile refuses large inputs.
    position = min(max(level * (needed.numel() + 1) - 1, 0.0), needed.numel() - 1.0)
    ordered = needed.sort().values
    below, above = ordered[math.floor(position)], ordered[math.ceil(position)]
    return (below + (above - below) * (position - math.floor(position))).item()


def _skip_pairs(
    model: LatentModel, data: TensorDictBase
) -> Iterator[tuple[int, Distribution, Tensor, Tensor | None]]:
    """For every skip: beliefs with batch ``(*B, T - skip)``, targets, and pairs that count."""
    predictor = model.predictor
    inputs = data.select(*model.encoder.in_keys, strict=False)
    latent = model.encoder(inputs).get(predictor.latent_key)
    batch = latent.shape[:-1]
    longest = max(predictor.skips)
    if not batch or batch[-1] <= longest:
        raise ValueError(
            f"data must hold windows (*B, T) longer than the largest skip {longest}, got {tuple(batch)}"
        )
    mask = step_mask(data, _MASK_KEYS, batch)
    flags = [data.get(key, None) for key in (("next", "done"), "is_init")]
    done, is_init = (None if flag is None else flag.reshape(batch).bool() for flag in flags)
    action = read(data, predictor.action_key, reader="calibration") if predictor.action_dim else None
    info = read(data, predictor.side_info_key, reader="calibration") if predictor.side_info_dim else None
    if mask is not None:
        # What is padded may be NaN.
        keep = mask.unsqueeze(-1)
        latent = torch.where(keep, latent, 0)
        action = None if action is None else torch.where(keep, action, 0)
        info = None if info is None else torch.where(keep, info, 0)
    for skip in predictor.skips:
        chunks = None if action is None else action_chunks(action, skip)
        side_info = None if info is None else info[..., skip:, :]
        p = predictor.dist(latent[..., :-skip, :], chunks, skip=skip, side_info=side_info)
        yield skip, p, latent[..., skip:, :], pair_mask(done, is_init, mask, skip)


def _checked_levels(levels: Sequence[float], like: Tensor) -> Tensor:
    if not len(levels):
        raise ValueError("levels must be at least one, got none")
    return like.new_tensor([check_level(float(level)) for level in levels])


def _measure(
    p: Belief,
    target: Tensor,
    mask: Tensor | None,
    joint: bool,
    num_samples: int,
    generator: torch.Generator | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Transform ``(*B, D)`` or ``(*B, 1)``, CRPS ``(*B, D)`` and energy score ``(*B, 1)``; NaN if masked."""
    pit = probability_integral_transform(
        p, target, mask=mask, joint=joint, num_samples=num_samples, generator=generator
    )
    marginal = crps(p, target, mask=mask, num_samples=num_samples, generator=generator)
    whole = energy_score(p, target, mask=mask, num_samples=num_samples, generator=generator)
    return pit.unsqueeze(-1) if joint else pit, marginal, whole.unsqueeze(-1)


def _row(
    measured: tuple[Tensor, Tensor, Tensor],
    mask: Tensor | None,
    levels: Tensor,
    num_bins: int,
    joint: bool,
    where: str,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    pit, marginal, whole = measured
    if pit.isnan().all():
        raise ValueError(f"target must count for each step ahead, but the mask leaves none for {where}")
    return (
        reliability_of(pit, levels, joint=joint),
        pit_histogram(pit, num_bins).density,
        masked_mean(marginal.mean(-1), mask),
        masked_mean(whole.squeeze(-1), mask),
    )


def _table(steps: tuple[int, ...], levels: Tensor, rows: Sequence[tuple[Tensor, ...]]) -> Calibration:
    return Calibration(steps, levels, *(torch.stack(column) for column in zip(*rows, strict=True)))
