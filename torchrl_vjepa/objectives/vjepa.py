"""The variational objective: sampled target, negative log-likelihood, KL of the target."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from torch import Tensor

from torchrl_vjepa.distributions import diag_gaussian, log_score
from torchrl_vjepa.models import VJEPA
from torchrl_vjepa.objectives.base import LatentPredictionLoss
from torchrl_vjepa.objectives.pairs import Pairs
from torchrl_vjepa.statistics import covariance_entropy, masked_moments

__all__ = ["VJEPALoss"]


class VJEPALoss(LatentPredictionLoss):
    r"""Regularised negative log-likelihood in latent space (``eq:vjepa_objective``).

    .. math::
        \mathcal L_{\text{VJEPA}} = \sum_\Delta w_\Delta\,
        \mathbb E_{Z_T \sim q_{\theta'}(\cdot \mid x_{t+\Delta})}
        \big[-\log p_\phi(Z_T \mid Z_t, u_{t:t+\Delta-1})\big]
        + \beta\, \mathbb E\, \mathrm{KL}\big(q_{\theta'}(Z_T \mid x_T) \,\|\, \mathcal N(0, I)\big)

    The target is one reparameterised sample of
    :math:`q_{\theta'} = \mathcal N(f_{\theta'}(x), \mathrm{diag}(\sigma^2_{\theta'}))`, drawn from the
    distribution itself (inside a LossModule TorchRL makes every module deterministic, and the paper's
    section "Necessity of Target Sampling" says what the mean would do). The mean of :math:`q` follows
    by EMA, its scale learns as ``target_scale_gradient`` says.

    Entries: ``loss_nll``, ``loss_target_kl``, ``loss_variance``, ``loss_covariance``, ``loss_entropy``,
    with ``residual_variance="batch"`` also ``loss_head``, with ``sliced_entropy_coeff`` also
    ``loss_sliced``. Diagnostics:
    ``effective_rank``, ``latent_std``, ``target_std``, ``mutual_information`` (the Gaussian form of
    the bound of ``thm:mi_bound``, in nats, mean over skips: the score by which restarts are chosen),
    ``nll_skip_<k>``.

    Args:
        model: the model, or a list of models that train as one batch (:class:`LatentPredictionLoss`).
        skip_weights: one weight for each skip of the predictor; equal by default.
        stacked_data: whether the windows come with a leading dimension of models.
        target_kl_coeff: :math:`\beta`.
        target_scale_gradient: what moves the scale of the target: ``"kl"``: the KL term alone (the
            paper's training section); ``"both"``: the likelihood too; ``"none"``: it stays as it is.
        residual_variance: ``"head"``: the likelihood is the head's, as printed (an ensemble's members
            each have their own, :func:`~torchrl_vjepa.distributions.log_score`); ``"batch"``: the
            representation and the mean are trained by the likelihood at the residual covariance that is
            optimal for the batch, in closed form, :math:`\hat\Sigma = \mathbb E\, r r^\top` with
            :math:`r = Z_T - \mu_\phi`, and the head by its own likelihood on detached latents
            (``loss_head``). A learned variance that lags behind starves the gradient of the most
            predictable directions; the closed form cannot lag, and a full one makes the objective
            independent of the basis of the latent space, which removes local minima.
        variance_coeff: weight of VICReg's variance term.
        covariance_coeff: weight of VICReg's covariance term.
        marginal_entropy_coeff: weight of the aggregate moments' KL to the unit Gaussian: the entropy
            term of the mutual information bound.
        sliced_entropy_coeff: weight of the entropy term in its sliced form (SIGReg); ``None`` for none.
        num_slices: number of random directions of the sliced form.
        collapse_rank: effective rank under which a :class:`CollapseWarning` is given.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.

    Raises:
        ValueError: if a coefficient is negative or not finite, or an option is unknown.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_vjepa import VJEPA, Predictor, linear_encoder
        >>> models = [
        ...     VJEPA(linear_encoder(20, 4), Predictor(4, action_dim=2, skips=(1, 2))) for _ in range(3)
        ... ]
        >>> loss = VJEPALoss(models, target_kl_coeff=0.01)
        >>> updater = SoftUpdate(loss, eps=0.99)
        >>> windows = TensorDict(
        ...     observation=torch.randn(8, 5, 20), action=torch.randn(8, 5, 2), batch_size=(8, 5)
        ... )
        >>> losses = loss(windows)
        >>> losses["loss_nll"].shape
        torch.Size([3])
        >>> sum(v.sum() for k, v in losses.items() if k.startswith("loss_")).backward()
        >>> updater.step()
        >>> best = loss.get_model(int(losses["mutual_information"].argmax()))
    """

    scale: TensorDictModuleBase
    scale_params: TensorDictParams
    target_scale_params: TensorDictParams

    _schedulable_buffers = frozenset({"target_kl_coeff"})
    _model_type = VJEPA
    # Not named target_scale: SoftUpdate would take it for the target of "scale".
    _parts = {**LatentPredictionLoss._parts, "scale": "target_scale"}

    def __init__(
        self,
        model: VJEPA | Sequence[VJEPA],
        *,
        skip_weights: Sequence[float] | None = None,
        stacked_data: bool = False,
        target_kl_coeff: float = 0.01,
        target_scale_gradient: Literal["kl", "both", "none"] = "kl",
        residual_variance: Literal["head", "batch"] = "head",
        variance_coeff: float = 0.0,
        covariance_coeff: float = 0.0,
        marginal_entropy_coeff: float = 0.0,
        sliced_entropy_coeff: float | None = None,
        num_slices: int = 64,
        collapse_rank: float = 1.2,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        if target_scale_gradient not in ("kl", "both", "none"):
            raise ValueError(
                f"target_scale_gradient must be 'kl', 'both' or 'none', got {target_scale_gradient!r}"
            )
        if residual_variance not in ("head", "batch"):
            raise ValueError(f"residual_variance must be 'head' or 'batch', got {residual_variance!r}")
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
        self._register_coeff("target_kl_coeff", target_kl_coeff)
        self.target_scale_gradient = target_scale_gradient
        self.residual_variance = residual_variance

    def _loss_keys(self) -> Iterator[str]:
        yield from ("loss_nll", "loss_target_kl")
        if self.residual_variance == "batch":
            yield "loss_head"
        yield from super()._loss_keys()

    def _diagnostic_keys(self) -> Iterator[str]:
        yield from super()._diagnostic_keys()
        yield from ("target_std", "mutual_information")
        yield from (f"nll_skip_{skip}" for skip in self.predictor.skips)

    def _target_std(self, data: TensorDictBase, params: dict[str, TensorDictBase]) -> Tensor:
        with params["scale"].to_module(self.scale):
            # Whatever an observation is, the scale reads it as one vector.
            std = self.scale.module(data.get(self.scale.in_keys[0]).flatten(2))
        std = std.float() if std.dtype in (torch.float16, torch.bfloat16) else std
        return std.detach() if self.target_scale_gradient == "none" else std

    def _target(self, latent: Tensor, data: TensorDictBase, params: dict[str, TensorDictBase]) -> Tensor:
        std = self._target_std(data, params)
        if self.target_scale_gradient != "both":
            std = std.detach()
        return diag_gaussian(latent, std).rsample()

    def _member_terms(
        self,
        pairs: list[Pairs],
        target_latent: Tensor,
        data: TensorDictBase,
        mask: Tensor | None,
        params: dict[str, TensorDictBase],
    ) -> dict[str, Tensor]:
        terms = {}
        if self.residual_variance == "head":
            nlls = head_nlls = [-log_score(pair.dist, pair.target) for pair in pairs]
        else:
            nlls = [self._profile_nll(pair) for pair in pairs]
            head_nlls = [
                -log_score(
                    self.predictor.dist(
                        pair.context.detach(), pair.action, skip=pair.skip, side_info=pair.side_info
                    ),
                    pair.target.detach(),
                )
                for pair in pairs
            ]
            terms["loss_head"] = self._reduce_pairs(head_nlls, pairs)
        terms["loss_nll"] = self._reduce_pairs(nlls, pairs)

        # KL(q || N(0, I)) per step; every step that counts is some pair's target or could be.
        std = self._target_std(data, params)
        variance = std.pow(2)
        kl = 0.5 * (target_latent.pow(2).sum(-1) + (variance - 1 - variance.log()).sum(-1))
        terms["loss_target_kl"] = self.target_kl_coeff * self._reduce([kl], [mask], kl.shape[1])

        if self.reduction != "none":
            with torch.no_grad():
                means = [pair.mean(nll) for pair, nll in zip(pairs, nlls, strict=True)]
                terms["target_std"] = std.mean()
                _, covariance = masked_moments(pairs[0].target, pairs[0].mask)
                nll = sum(w * m for w, m in zip(self.skip_weights, means, strict=True))
                terms["mutual_information"] = covariance_entropy(covariance) - nll
                for pair, head_nll in zip(pairs, head_nlls, strict=True):
                    terms[f"nll_skip_{pair.skip}"] = pair.mean(head_nll).detach()
        return terms

    @staticmethod
    def _profile_nll(pair: Pairs) -> Tensor:
        """Gaussian likelihood at the residual covariance that is optimal for the batch."""
        residual = pair.dist.mean - pair.target
        # At its optimum the covariance has no gradient, so it is a constant here: the gradient is that
        # of the profile likelihood, log det E[r r^T] / 2.
        with torch.no_grad():
            covariance = pair.second_moment(residual)
            jitter = 1e-6 * covariance.diagonal().mean() + 1e-12
            eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
            covariance = covariance + jitter * eye
            precision = torch.linalg.inv(covariance)
            constant = torch.logdet(covariance) + covariance.shape[-1] * math.log(2 * math.pi)
        return 0.5 * ((residual @ precision * residual).sum(-1) + constant)
