"""The squared loss of the deterministic JEPA."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

from tensordict import TensorDictBase
from torch import Tensor

from torchrl_vjepa.models import JEPA
from torchrl_vjepa.objectives.base import LatentPredictionLoss
from torchrl_vjepa.objectives.pairs import Pairs
from torchrl_vjepa.stacking import squared_distance

__all__ = ["JEPALoss"]


class JEPALoss(LatentPredictionLoss):
    r"""Squared prediction error in latent space (``eq:JEPA_squared_loss``).

    .. math::
        \mathcal L_{\text{JEPA}} = \sum_\Delta w_\Delta\, \mathbb E\,
        \big\| g_\phi(f_\theta(x_t), u_{t:t+\Delta-1}) - f_{\theta'}(x_{t+\Delta}) \big\|^2

    where :math:`g_\phi` is the predictive mean. The paper's JEPA adds VICReg: ``prediction_coeff=25/D``
    (VICReg averages the square over the D dimensions), ``variance_coeff=25``, ``covariance_coeff=1``.

    Entries: ``loss_prediction``, ``loss_variance``, ``loss_covariance``, ``loss_entropy``, with
    ``sliced_entropy_coeff`` also ``loss_sliced``; diagnostics ``effective_rank``, ``latent_std``,
    ``error_skip_<k>``.

    Args:
        model: the model, or a list of models that train as one batch (:class:`LatentPredictionLoss`).
        skip_weights: one weight for each skip of the predictor; equal by default.
        stacked_data: whether the windows come with a leading dimension of models.
        prediction_coeff: weight of the squared error.
        variance_coeff: weight of VICReg's variance term.
        covariance_coeff: weight of VICReg's covariance term.
        marginal_entropy_coeff: weight of the aggregate moments' KL to the unit Gaussian.
        sliced_entropy_coeff: weight of the entropy term in its sliced form (SIGReg); ``None`` for none.
        num_slices: number of random directions of the sliced form.
        collapse_rank: effective rank under which a :class:`CollapseWarning` is given.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.

    Raises:
        ValueError: if a coefficient is negative or not finite, or ``reduction`` is unknown.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_vjepa import JEPA, DeltaHead, Predictor, linear_encoder
        >>> model = JEPA(linear_encoder(20, 4), Predictor(4, action_dim=2, head=DeltaHead()))
        >>> loss = JEPALoss(model, variance_coeff=1.0)
        >>> updater = SoftUpdate(loss, eps=0.99)
        >>> windows = TensorDict(
        ...     observation=torch.randn(8, 5, 20), action=torch.randn(8, 5, 2), batch_size=(8, 5)
        ... )
        >>> losses = loss(windows)
        >>> sum(v for k, v in losses.items() if k.startswith("loss_")).backward()
        >>> updater.step()
    """

    _schedulable_buffers = frozenset({"prediction_coeff"})

    def __init__(
        self,
        model: JEPA | Sequence[JEPA],
        *,
        skip_weights: Sequence[float] | None = None,
        stacked_data: bool = False,
        prediction_coeff: float = 1.0,
        variance_coeff: float = 0.0,
        covariance_coeff: float = 0.0,
        marginal_entropy_coeff: float = 0.0,
        sliced_entropy_coeff: float | None = None,
        num_slices: int = 64,
        collapse_rank: float = 1.2,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        super().__init__(
            model,
            skip_weights=skip_weights,
            stacked_data=stacked_data,
            variance_coeff=variance_coeff,
            covariance_coeff=covariance_coeff,
            marginal_entropy_coeff=marginal_entropy_coeff,
            sliced_entropy_coeff=sliced_entropy_coeff,
            num_slices=num_slices,
            collapse_rank=collapse_rank,
            reduction=reduction,
        )
        self._register_coeff("prediction_coeff", prediction_coeff)

    def _loss_keys(self) -> Iterator[str]:
        yield "loss_prediction"
        yield from super()._loss_keys()

    def _diagnostic_keys(self) -> Iterator[str]:
        yield from super()._diagnostic_keys()
        yield from (f"error_skip_{skip}" for skip in self.predictor.skips)

    def _pair_outputs(self, pairs: Pairs, params: dict[str, TensorDictBase]) -> dict[str, Tensor]:
        return {"error": squared_distance(pairs.dist.mean, pairs.target)}

    def _member_terms(self, outputs: dict[str, Tensor], masks: dict[str, Tensor]) -> dict[str, Tensor]:
        if self.reduction == "none":
            return {"loss_prediction": self.prediction_coeff * self._pad_pairs("error", outputs, masks)}
        errors = self._pair_means("error", outputs, masks)
        terms = {"loss_prediction": self.prediction_coeff * self._reduce_means(errors, outputs, masks)}
        if self._wants_diagnostics:
            pairs = zip(self.skips, errors, strict=True)
            terms |= {f"error_skip_{skip}": error.detach() for skip, error in pairs}
        return terms
