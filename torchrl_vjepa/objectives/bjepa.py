"""The objective of BJEPA: that of VJEPA and a structural prior on the prediction."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from torch import Tensor

from torchrl_vjepa.distributions import kl_divergence
from torchrl_vjepa.models import BJEPA
from torchrl_vjepa.objectives.pairs import Pairs
from torchrl_vjepa.objectives.vjepa import VJEPALoss
from torchrl_vjepa.priors import Prior

__all__ = ["BJEPALoss"]


class BJEPALoss(VJEPALoss):
    r"""Likelihood, reference prior and structural prior (``eq:bjepa_training_objective``).

    .. math::
        \mathcal L_{\text{BJEPA}} = \mathcal L_{\text{VJEPA}} + \gamma \sum_\Delta w_\Delta\,
        \mathbb E\, \mathrm{KL}\big(p_{\text{like}}(Z_T \mid Z_C) \,\|\, p_{\text{struct}}(Z_T)\big)

    :math:`p_{\text{struct}}` is the model's ``structural_prior``: any with a log-density, also one that is
    not normalised (the term is then known up to a constant). A learned one moves with this term alone.
    One that takes a task takes the context latent :math:`Z_C` of each pair
    (:class:`~torchrl_vjepa.priors.SlownessPrior`), as the encoder gives it, gradient included.
    The reference prior of the :math:`\beta` term is :math:`\mathcal N(0, I)`.

    Entries: those of :class:`VJEPALoss` and ``loss_structural_kl``; diagnostic ``structural_kl``
    (in nats, without :math:`\gamma`).

    Args:
        model: the model, or a list of models that train as one batch.
        structural_kl_coeff: :math:`\gamma`.
        num_kl_samples: draws of the unbiased estimate of the divergence where there is no closed form
            (mixtures, ensembles and flows, and energies as priors; see
            :func:`~torchrl_vjepa.distributions.monte_carlo_kl`), at least 2.
        **kwargs: see :class:`VJEPALoss`.

    Raises:
        ValueError: if a coefficient is negative or not finite, ``num_kl_samples`` is below 2, an option
            is unknown, or the structural prior needs another task than the context.

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
        for m in self._checked(model):
            needed = [unravel_key(key) for key in getattr(m.structural_prior, "in_keys", [])]
            if any(key != unravel_key(m.latent_key) for key in needed):
                raise ValueError(
                    f"structural_prior must read the context latent {m.latent_key!r} or nothing, got "
                    f"in_keys={needed}; bind(task) fixes any other task"
                )
        super().__init__(model, **kwargs)
        self.num_kl_samples = int(num_kl_samples)
        self._register_coeff("structural_kl_coeff", structural_kl_coeff)

    def _loss_keys(self) -> Iterator[str]:
        yield from super()._loss_keys()
        yield "loss_structural_kl"

    def _diagnostic_keys(self) -> Iterator[str]:
        yield from super()._diagnostic_keys()
        yield "structural_kl"

    def _pair_outputs(self, pairs: Pairs, params: dict[str, TensorDictBase]) -> dict[str, Tensor]:
        outputs = super()._pair_outputs(pairs, params)
        with params["prior"].to_module(self.prior):
            prior = self.prior.module
            task = {unravel_key(self.predictor.latent_key): pairs.context}
            outputs["structural"] = kl_divergence(
                pairs.dist,
                prior(task) if isinstance(prior, Prior) else prior(),
                num_samples=self.num_kl_samples,
            )
        return outputs

    def _member_terms(self, outputs: dict[str, Tensor], masks: dict[str, Tensor]) -> dict[str, Tensor]:
        terms = super()._member_terms(outputs, masks)
        if self.reduction == "none":
            structural = self._pad_pairs("structural", outputs, masks)
        else:
            means = self._pair_means("structural", outputs, masks)
            structural = self._reduce_means(means, outputs, masks)
            if self._wants_diagnostics:
                terms["structural_kl"] = self._over_skips(means).detach()
        terms["loss_structural_kl"] = self.structural_kl_coeff * structural
        return terms
