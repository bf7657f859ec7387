"""The objective of BJEPA: that of VJEPA and a structural prior on the prediction."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from torch import Tensor

from torchrl_vjepa.distributions import kl_divergence
from torchrl_vjepa.models import BJEPA
from torchrl_vjepa.objectives.pairs import Pairs
from torchrl_vjepa.objectives.vjepa import VJEPALoss

__all__ = ["BJEPALoss"]


class BJEPALoss(VJEPALoss):
    r"""Likelihood, reference prior and structural prior (``eq:bjepa_training_objective``).

    .. math::
        \mathcal L_{\text{BJEPA}} = \mathcal L_{\text{VJEPA}} + \gamma \sum_\Delta w_\Delta\,
        \mathbb E\, \mathrm{KL}\big(p_{\text{like}}(Z_T \mid Z_C) \,\|\, p_{\text{struct}}(Z_T)\big)

    :math:`p_{\text{struct}}` is the model's ``structural_prior``; a learned one moves with this term
    alone. The reference prior of the :math:`\beta` term is :math:`\mathcal N(0, I)`.

    Entries: those of :class:`VJEPALoss` and ``loss_structural_kl``; diagnostic ``structural_kl``
    (in nats, without :math:`\gamma`).

    Args:
        model: the model, or a list of models that train as one batch.
        structural_kl_coeff: :math:`\gamma`.
        num_kl_samples: draws of the unbiased estimate of the divergence where there is no closed form
            (mixtures, ensembles and flows; see
            :func:`~torchrl_vjepa.distributions.monte_carlo_kl`), at least 2.
        **kwargs: see :class:`VJEPALoss`.

    Raises:
        ValueError: if a coefficient is negative or not finite, ``num_kl_samples`` is below 2, or an option
            is unknown.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_vjepa import BJEPA, Predictor, linear_encoder
        >>> loss = BJEPALoss(BJEPA(linear_encoder(20, 4), Predictor(4)), structural_kl_coeff=0.1)
        >>> updater = SoftUpdate(loss, eps=0.99)
        >>> losses = loss(TensorDict(observation=torch.randn(8, 5, 20), batch_size=(8, 5)))
        >>> losses["loss_structural_kl"].shape
        torch.Size([])
    """

    prior: TensorDictModuleBase
    prior_params: TensorDictParams
    target_prior_params: TensorDictParams

    _schedulable_buffers = frozenset({"structural_kl_coeff"})
    _model_type = BJEPA
    _parts = {**VJEPALoss._parts, "prior": "structural_prior_module"}

    def __init__(
        self,
        model: BJEPA | Sequence[BJEPA],
        *,
        structural_kl_coeff: float = 0.1,
        num_kl_samples: int = 8,
        **kwargs: Any,
    ) -> None:
        if num_kl_samples < 2:
            raise ValueError(f"num_kl_samples must be at least 2, got {num_kl_samples}")
        super().__init__(model, **kwargs)
        self.num_kl_samples = int(num_kl_samples)
        self._register_coeff("structural_kl_coeff", structural_kl_coeff)

    def _loss_keys(self) -> Iterator[str]:
        yield from super()._loss_keys()
        yield "loss_structural_kl"

    def _diagnostic_keys(self) -> Iterator[str]:
        yield from super()._diagnostic_keys()
        yield "structural_kl"

    def _member_terms(
        self,
        pairs: list[Pairs],
        target_latent: Tensor,
        data: TensorDictBase,
        mask: Tensor | None,
        params: dict[str, TensorDictBase],
    ) -> dict[str, Tensor]:
        terms = super()._member_terms(pairs, target_latent, data, mask, params)
        with params["prior"].to_module(self.prior):
            prior = self.prior.module()
            kls = [kl_divergence(pair.dist, prior, num_samples=self.num_kl_samples) for pair in pairs]
        terms["loss_structural_kl"] = self.structural_kl_coeff * self._reduce_pairs(kls, pairs)
        if self.reduction != "none":
            means = [pair.mean(kl) for pair, kl in zip(pairs, kls, strict=True)]
            weighted = [w * mean for w, mean in zip(self.skip_weights, means, strict=True)]
            terms["structural_kl"] = torch.stack(weighted).sum().detach()
        return terms
