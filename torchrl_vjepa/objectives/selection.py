"""Restarts: of several models trained as one batch, the one that a score prefers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_vjepa.objectives.window_loss import WindowLoss

__all__ = ["Selection", "select_best"]


@dataclass(frozen=True)
class Selection:
    """The model that a score prefers.

    Attributes:
        model: the model with its trained parameters, as :meth:`WindowLoss.get_model` hands it back.
        index: its place in the list.
        scores: the scores of all models, shape ``(num_models,)``; NaN for a run that diverged.

    Examples:
        >>> import torch
        >>> selection = Selection("a model", 1, torch.tensor([0.2, 0.7]))
        >>> selection.index
        1
    """

    model: Any
    index: int
    scores: Tensor


@torch.no_grad()
def select_best(
    loss: WindowLoss,
    windows: TensorDictBase,
    score: str = "mutual_information",
    *,
    maximize: bool = True,
) -> Selection:
    r"""Choose among models that trained as one batch, without labels.

    The default score is the bound of ``thm:mi_bound``, which :class:`~torchrl_vjepa.VJEPALoss` and
    :class:`~torchrl_vjepa.BJEPALoss` report: the information that the latent holds about its future, in
    nats. It does not depend on the scale of the latent, as the likelihood does. Every model is scored
    on the same windows with the same random numbers; a run that diverged (NaN) is never chosen.

    Args:
        loss: a loss with a list of models.
        windows: windows to score on, ``(*B, T)``: better others than those trained on.
        score: an entry that the loss returns, one number for each model. For
            :class:`~torchrl_vjepa.JEPALoss`, say, ``"error_skip_1"`` with ``maximize=False`` (its scale is
            that of the latent: hold it with ``marginal_entropy_coeff`` or VICReg).
        maximize: whether a larger score is better.

    Returns:
        The best model, its index, and all scores.

    Raises:
        KeyError: if the loss returns no entry ``score``.
        ValueError: if the loss has a single model, ``score`` is not one number for each model, or no
            score is finite.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_vjepa import VJEPA, Predictor, VJEPALoss, linear_encoder
        >>> models = [VJEPA(linear_encoder(20, 4), Predictor(4)) for _ in range(3)]
        >>> loss = VJEPALoss(models)
        >>> updater = SoftUpdate(loss, eps=0.99)
        >>> windows = TensorDict(observation=torch.randn(8, 5, 20), batch_size=(8, 5))
        >>> best = select_best(loss, windows)
        >>> best.model is models[best.index], best.scores.shape
        (True, torch.Size([3]))
    """
    if loss.num_models is None:
        raise ValueError(f"loss must hold a list of models, got a {type(loss).__name__} of a single one")
    losses = loss(windows)
    value = losses.get(score, None)
    if value is None:
        raise KeyError(
            f"score must be an entry of the losses, one of {list(losses.keys())}, got {score!r}; after "
            "select_out_keys call reset_out_keys first"
        )
    scores: Tensor = value.detach()
    if scores.shape != (loss.num_models,):
        raise ValueError(
            f"score must be one number for each of the {loss.num_models} models, got {score!r} of shape "
            f"{tuple(scores.shape)}; build the loss with reduction='mean'"
        )
    # argmax takes NaN for the largest number.
    ranked = torch.where(scores.isfinite(), scores if maximize else -scores, -torch.inf)
    index = int(ranked.argmax())
    if ranked[index] == -torch.inf:
        raise ValueError(f"score must be finite for some model, got {score}={scores.tolist()}")
    return Selection(loss.get_model(index), index, scores)
