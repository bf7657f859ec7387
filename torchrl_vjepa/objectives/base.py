"""What the losses of the joint-embedding models share: target encoder, skips, regularisers."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Iterator, Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from torch import Tensor

from torchrl_vjepa.models import JEPA
from torchrl_vjepa.objectives.pairs import Pairs, mean_over, rows_of
from torchrl_vjepa.objectives.window_loss import WindowLoss
from torchrl_vjepa.predictor import Predictor
from torchrl_vjepa.stacking import features_first
from torchrl_vjepa.statistics import (
    eigenvalues,
    row_distance,
    row_moments,
    spectrum_entropy,
    spectrum_rank,
)
from torchrl_vjepa.windows import action_chunks

__all__ = ["CollapseWarning", "LatentPredictionLoss"]


class CollapseWarning(UserWarning):
    """The latents of a model in training use fewer directions than they should.

    Examples:
        >>> issubclass(CollapseWarning, UserWarning)
        True
    """


class LatentPredictionLoss(WindowLoss):
    r"""Parent of the losses of JEPA, VJEPA and BJEPA.

    A batch of windows is encoded once by the context encoder :math:`f_\theta` and once by the target
    encoder :math:`f_{\theta'}`; for every skip :math:`\Delta` of the predictor the prediction from
    :math:`Z_t` and :math:`u_{t:t+\Delta-1}` meets the target at :math:`t + \Delta`. What does not count
    (:class:`WindowLoss`) does not enter batch statistics either.

    :math:`\theta'` follows :math:`\theta` by ``SoftUpdate(loss, eps=tau)``
    (``eq:target_encoder_weights_EMA``). Buffers of the encoder (whitening statistics) are not averaged:
    the target encoder reads the context encoder's own.

    Args:
        model: the model, or a list of models that train as one batch.
        skip_weights: one weight for each skip of the predictor, normalised to sum to one; equal by
            default. Long skips tell slow distractors from the signal; weighting them up removes local
            minima.
        stacked_data: whether the windows come with a leading dimension of models.
        variance_coeff: weight of VICReg's variance term,
            :math:`\frac1D\sum_d \max(0, 1 - \sqrt{\mathrm{Var}[Z_d] + 10^{-4}})`.
        covariance_coeff: weight of VICReg's covariance term, :math:`\frac1D \sum_{i \ne j} C_{ij}^2`.
        marginal_entropy_coeff: weight of the entropy term of the mutual information bound
            (``thm:mi_bound``) in its moment form,
            :math:`\mathrm{KL}(\mathcal N(m, S) \,\|\, \mathcal N(0, I))` of the aggregate latent
            moments: it maximises the Gaussian entropy :math:`\frac12 \log\det S` and keeps the scale.
        sliced_entropy_coeff: weight of the entropy term in its sliced form (SIGReg,
            :func:`~torchrl_vjepa.statistics.sliced_gaussian_distance`), for latents of many dimensions:
            the entry ``loss_sliced``. ``None`` leaves it out; with a number it can be scheduled, also
            from 0.
        num_slices: number of random directions of the sliced form.
        collapse_rank: a :class:`CollapseWarning` is given once when the effective rank of the latents
            falls under it; 0 for never.
        reduction: ``"mean"`` over pairs and skips, ``"sum"`` over pairs (mean over skips), or
            ``"none"``: losses of shape ``(B, T)``, without scalar diagnostics.

    Raises:
        ValueError: if a coefficient is negative or not finite, ``num_slices`` is not positive, or
            ``reduction`` is unknown.

    Examples:
        >>> from torchrl_vjepa import JEPALoss
        >>> issubclass(JEPALoss, LatentPredictionLoss)
        True
    """

    encoder: TensorDictModuleBase
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams
    predictor: Predictor
    predictor_params: TensorDictParams
    target_predictor_params: TensorDictParams
    sliced_entropy_coeff: Tensor | None

    _schedulable_buffers = frozenset(
        {"variance_coeff", "covariance_coeff", "marginal_entropy_coeff", "sliced_entropy_coeff"}
    )
    _model_type = JEPA
    #: Parts of the model whose parameters the loss takes: their name here, their attribute there.
    _parts: dict[str, str] = {"encoder": "encoder", "predictor": "predictor"}
    #: The effective rank is compared with ``collapse_rank`` in every so many calls: it makes a GPU wait.
    collapse_interval: int = 20

    def __init__(
        self,
        model: JEPA | Sequence[JEPA],
        *,
        skip_weights: Sequence[float] | None = None,
        stacked_data: bool = False,
        variance_coeff: float = 0.0,
        covariance_coeff: float = 0.0,
        marginal_entropy_coeff: float = 0.0,
        sliced_entropy_coeff: float | None = None,
        num_slices: int = 64,
        collapse_rank: float = 1.2,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        models = self._checked(model)
        super().__init__(
            model,
            self._parts,
            targets=("encoder",),
            skips=models[0].predictor.skips,
            skip_weights=skip_weights,
            stacked_data=stacked_data,
            reduction=reduction,
        )
        self._shared_keys = [
            key
            for key, value in self.encoder_params.items(True, True)
            if not isinstance(value, torch.nn.Parameter)
        ]
        self._register_coeff("variance_coeff", variance_coeff)
        self._register_coeff("covariance_coeff", covariance_coeff)
        self._register_coeff("marginal_entropy_coeff", marginal_entropy_coeff)
        if num_slices < 1:
            raise ValueError(f"num_slices must be positive, got {num_slices}")
        self.num_slices = num_slices
        if sliced_entropy_coeff is None:
            # An empty buffer, so that assigning a number later is an error instead of being ignored.
            self.register_buffer("sliced_entropy_coeff", None)
        else:
            self._register_coeff("sliced_entropy_coeff", sliced_entropy_coeff)
        self.collapse_rank = float(collapse_rank)
        self._calls = 0
        self._warned = False

    def target_encoder(self, index: int | None = None) -> TensorDictModuleBase:
        r"""The target encoder :math:`f_{\theta'}` as it is now: what maps a goal observation to a latent.

        Args:
            index: of which model, if the loss was given a list.

        Returns:
            A copy of the encoder with the averaged parameters, frozen and in evaluation mode.

        Raises:
            ValueError: if ``index`` is missing for a list, given for a single model, or out of range.

        Examples:
            >>> from torchrl.objectives import SoftUpdate
            >>> from torchrl_vjepa import JEPA, GoalPrior, JEPALoss, Predictor, linear_encoder
            >>> loss = JEPALoss(JEPA(linear_encoder(20, 4), Predictor(4)))
            >>> updater = SoftUpdate(loss, eps=0.99)
            >>> goal = GoalPrior(loss.target_encoder(), std=0.1)
        """
        encoder = copy.deepcopy(self._model_at(index).encoder)
        params = self._target_params()
        own = TensorDict.from_module(encoder)
        own.data.update_(params.data if index is None else params.data[index])
        return encoder.requires_grad_(False).eval()

    def _action_entry(self) -> tuple[NestedKey, int]:
        return self.predictor.action_key, self.predictor.action_dim

    def _required_keys(self) -> list[NestedKey]:
        return [self.encoder.in_keys[0], *self.predictor.in_keys[1:]]

    def _loss_keys(self) -> Iterator[str]:
        yield from ("loss_variance", "loss_covariance", "loss_entropy")
        if self.sliced_entropy_coeff is not None:
            yield "loss_sliced"

    def _diagnostic_keys(self) -> Iterator[str]:
        yield from ("effective_rank", "latent_std")

    # What a member adds

    def _target(
        self, outputs: dict[str, Tensor], data: TensorDictBase, params: dict[str, TensorDictBase]
    ) -> Tensor:
        """What is predicted, ``(*N, B, T, D)``: by default the latents of the target encoder."""
        return outputs["target"]

    def _pair_outputs(self, pairs: Pairs, params: dict[str, TensorDictBase]) -> dict[str, Tensor]:
        """What the member needs of each pair: ``(R, ...)`` of one model, ``(N, R, ...)`` of stacked ones."""
        raise TypeError(f"{type(self).__name__} is not a loss by itself: use one of its members")

    def _member_terms(self, outputs: dict[str, Tensor], masks: dict[str, Tensor]) -> dict[str, Tensor]:
        """The member's own ``loss_*`` entries and diagnostics."""
        raise TypeError(f"{type(self).__name__} is not a loss by itself: use one of its members")

    # The computation

    def _params(self) -> tuple[TensorDictBase, ...]:
        return (self._target_params(), *super()._params())

    def _target_params(self) -> TensorDictBase:
        # A copy of the structure, because to_module() would register the targets as parameters in it.
        target = TensorDict(
            dict(self.target_encoder_params.items()), self.target_encoder_params.batch_size
        ).clone(recurse=False)
        for key in self._shared_keys:
            target.set(key, self.encoder_params.get(key))
        return target

    def _networks(self, data: TensorDictBase, *params: TensorDictBase) -> dict[str, Tensor]:
        named = dict(zip(("target", *self._modules_of_model), params, strict=True))
        predictor = self.predictor
        latent = self._encode(data, named["encoder"], predictor.latent_key)
        with torch.no_grad():
            target_latent = self._encode(data, named["target"], predictor.latent_key)
        outputs = {"latent": latent, "target": target_latent}
        target = self._target(outputs, data, named)
        action = data.get(predictor.action_key) if predictor.action_dim else None
        side_info = data.get(predictor.side_info_key) if predictor.side_info_dim else None
        with named["predictor"].to_module(predictor):
            for skip in predictor.skips:
                context = self._flat(latent, slice(-skip))
                chunks = info = None
                if action is not None:
                    chunks = _like(context, action_chunks(action, skip).flatten(-4, -3), 2)
                if side_info is not None:
                    info = _like(context, side_info[..., skip:, :].flatten(-3, -2), 1)
                p = predictor.dist(context, chunks, skip=skip, side_info=info)
                pairs = Pairs(skip, p, self._flat(target, slice(skip, None)), context, chunks, info)
                with torch.autocast(latent.device.type, enabled=False):
                    of_pairs = self._pair_outputs(pairs, named)
                outputs.update({f"{name}_{skip}": value for name, value in of_pairs.items()})
        return outputs

    def _terms(
        self, data: TensorDictBase, masks: dict[str, Tensor], outputs: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        latent = outputs["latent"]
        rows = features_first(latent)
        mask = rows_of(masks.get("steps"))
        with torch.autocast(latent.device.type, enabled=False):
            terms = self._member_terms(outputs, masks)
            # Without a regulariser the moments are diagnostics: no gradient flows through them.
            coeffs = ("variance_coeff", "covariance_coeff", "marginal_entropy_coeff")
            moved = any(map(self._is_active, coeffs))
            if moved or self._wants_diagnostics or self.reduction == "none":
                with torch.set_grad_enabled(moved and torch.is_grad_enabled()):
                    mean, covariance = row_moments(rows, mask)
                    values = eigenvalues(covariance)
                    terms.update(self._regularisers(mean, covariance, values))
            else:
                zero = latent.new_zeros(latent.shape[:-3])
                terms |= {"loss_variance": zero, "loss_covariance": zero, "loss_entropy": zero}
            if self.sliced_entropy_coeff is not None:
                distance = row_distance(rows, mask, num_slices=self.num_slices)
                terms["loss_sliced"] = self.sliced_entropy_coeff * distance
            if self._wants_diagnostics:
                terms["effective_rank"] = spectrum_rank(values.detach())
                deviations = covariance.detach().diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
                terms["latent_std"] = deviations.mean(-1)
        if self.reduction == "none":
            # Regularisers belong to the batch: the same number at every step.
            shape = latent.shape[:-1]
            terms = {
                key: value if value.shape == shape else value[..., None, None].expand(shape)
                for key, value in terms.items()
                if key.startswith("loss_")
            }
        return terms

    def _is_active(self, coeff: str) -> bool:
        """Whether a coefficient may be other than zero; only on a CPU looking costs nothing."""
        value = getattr(self, coeff)
        return torch.compiler.is_compiling() or value.device.type != "cpu" or bool((value != 0).any())

    def _pad_pairs(self, name: str, outputs: dict[str, Tensor], masks: dict[str, Tensor]) -> Tensor:
        """For ``reduction="none"``: the entries ``name`` of all skips as ``(*N, B, T)``."""
        length, skips = outputs["latent"].shape[-2], self.predictor.skips
        windows = [outputs[f"{name}_{skip}"].unflatten(-1, (-1, length - skip)) for skip in skips]
        return self._reduce(windows, [masks.get(str(skip)) for skip in skips], length)

    def _pair_means(self, name: str, outputs: dict[str, Tensor], masks: dict[str, Tensor]) -> list[Tensor]:
        """For each skip the mean of the entry ``name`` over the pairs that count, ``(*N)``."""
        return [mean_over(outputs[f"{name}_{skip}"], rows_of(masks.get(str(skip)))) for skip in self.skips]

    def _reduce_means(
        self, means: list[Tensor], outputs: dict[str, Tensor], masks: dict[str, Tensor]
    ) -> Tensor:
        """Reduce the means over pairs of each skip over the skips."""
        if self.reduction == "sum":
            *_, windows, length, _ = outputs["latent"].shape
            counts = [
                windows * (length - skip) if mask is None else mask.sum((-2, -1))
                for skip, mask in ((skip, masks.get(str(skip))) for skip in self.skips)
            ]
            means = [mean * count for mean, count in zip(means, counts, strict=True)]
        return self._over_skips(means)

    def _regularisers(self, mean: Tensor, covariance: Tensor, values: Tensor) -> dict[str, Tensor]:
        variance = covariance.diagonal(dim1=-2, dim2=-1)
        dim = mean.shape[-1]
        off_diagonal = covariance.square().sum((-2, -1)) - variance.square().sum(-1)
        # KL(N(m, S) || N(0, I)) = (tr S + |m|^2 - D - log det S) / 2; the entropy is the log det's half.
        trace = (variance + mean.square()).sum(-1)
        gaussian_constant = 0.5 * dim * math.log(2 * math.pi)
        if not self._is_active("marginal_entropy_coeff"):
            values = values.detach()  # an eigenvalue problem that nothing moves needs no gradient
        divergence = 0.5 * trace + gaussian_constant - spectrum_entropy(values)
        return {
            "loss_variance": self.variance_coeff * (1 - (variance + 1e-4).sqrt()).relu().mean(-1),
            "loss_covariance": self.covariance_coeff * off_diagonal / dim,
            "loss_entropy": self.marginal_entropy_coeff * divergence,
        }

    def _watch(self, terms: dict[str, Tensor]) -> None:
        rank = terms.get("effective_rank")
        if rank is None or torch.compiler.is_compiling() or not self.training or self._warned:
            return
        self._calls += 1
        if (self._calls - 1) % self.collapse_interval or not self.collapse_rank:
            return
        low = rank.detach().min().item()
        if low < self.collapse_rank:
            self._warned = True
            which = "" if self.num_models is None else f" (model {int(rank.argmin())})"
            warnings.warn(
                f"the latents have collapsed: effective rank {low:.2f} of {self.predictor.latent_dim}{which} "
                f"is under collapse_rank={self.collapse_rank}; whiten the observations (Whitening), raise "
                "marginal_entropy_coeff or the VICReg coefficients, or lower the learning rate",
                CollapseWarning,
                stacklevel=3,
            )


def _like(context: Tensor, value: Tensor, event_dims: int) -> Tensor:
    """What all models share, ``(R, *event)``, with the dimension of models of the contexts."""
    return value.expand(*context.shape[:-1], *value.shape[-event_dims:])
