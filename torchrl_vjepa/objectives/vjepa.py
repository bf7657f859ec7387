"""The variational objective: sampled target, negative log-likelihood, KL of the target."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from torch import Tensor

from torchrl_vjepa.distributions import log_score
from torchrl_vjepa.heads import TargetScale
from torchrl_vjepa.models import VJEPA
from torchrl_vjepa.objectives.base import LatentPredictionLoss
from torchrl_vjepa.objectives.pairs import Pairs, mean_over, rows_of, second_moment
from torchrl_vjepa.stacking import columns, features_first, shared_noise
from torchrl_vjepa.statistics import covariance_entropy, row_moments

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
    ``effective_rank``, ``latent_std``, ``target_kl`` (in nats, without :math:`\beta`), ``target_std``,
    ``mutual_information`` (the Gaussian form of
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
        yield from ("target_kl", "target_std", "mutual_information")
        yield from (f"nll_skip_{skip}" for skip in self.predictor.skips)

    def _required_keys(self) -> list[NestedKey]:
        keys = super()._required_keys()
        read = self.scale.in_keys[0]
        # The last key tells the shape of the batch.
        return keys if read in keys else [keys[0], read, *keys[1:]] if len(keys) > 1 else [read, *keys]

    def _target(
        self, outputs: dict[str, Tensor], data: TensorDictBase, params: dict[str, TensorDictBase]
    ) -> Tensor:
        # Whatever an observation is, the scale reads it as one vector.
        rows = data.get(self.scale.in_keys[0]).flatten(data.ndim).flatten(-3, -2)
        with params["scale"].to_module(self.scale):
            module = self.scale.module
            log_var = module.log_variance(rows) if isinstance(module, TargetScale) else 2 * module(rows).log()
        log_var = log_var.float() if log_var.dtype in (torch.float16, torch.bfloat16) else log_var
        if log_var.ndim > 1:  # (*N, R, D), or (*N, 1, D) where rows share it
            shared = log_var.shape[-2] == 1
            log_var = log_var.unflatten(-2, (1, 1) if shared else data.shape[-2:])
        if self.target_scale_gradient == "none":
            log_var = log_var.detach()
        outputs["target_log_var"] = log_var
        std = (0.5 * (log_var if self.target_scale_gradient == "both" else log_var.detach())).exp()
        mean = outputs["target"]
        return torch.addcmul(mean, std.to(mean.dtype), shared_noise(mean, 3))

    def _pair_outputs(self, pairs: Pairs, params: dict[str, TensorDictBase]) -> dict[str, Tensor]:
        if self.residual_variance == "head":
            return {"nll": -log_score(pairs.dist, pairs.target)}
        # The head's own likelihood moves the predictor alone.
        p = self.predictor.dist(
            pairs.context.detach(), pairs.action, skip=pairs.skip, side_info=pairs.side_info
        )
        return {
            "residual": pairs.dist.mean - pairs.target,
            "nll": -log_score(p, pairs.target.detach()),
        }

    def _member_terms(self, outputs: dict[str, Tensor], masks: dict[str, Tensor]) -> dict[str, Tensor]:
        if self.reduction == "none":
            return self._terms_of_each_pair(outputs, masks)
        terms = {}
        head_nlls = self._pair_means("nll", outputs, masks)
        if self.residual_variance == "head":
            nlls = head_nlls
        else:
            nlls = self._profile_means(outputs, masks)
            terms["loss_head"] = self._reduce_means(head_nlls, outputs, masks)
        terms["loss_nll"] = self._reduce_means(nlls, outputs, masks)

        # KL(q || N(0, I)) = (|f|^2 + sum_d (sigma_d^2 - 1 - log sigma_d^2)) / 2
        rows, mask = features_first(outputs["target"]), rows_of(masks.get("steps"))
        square = mean_over(rows.square().sum(-1), mask)
        kl = 0.5 * (square + self._scale_divergence(outputs, mask))
        terms["loss_target_kl"] = self.target_kl_coeff * kl
        if self.reduction == "sum":
            steps = rows.shape[-2] if mask is None else mask.sum(-1)
            terms["loss_target_kl"] = terms["loss_target_kl"] * steps

        if self._wants_diagnostics:
            with torch.no_grad():
                _, covariance = row_moments(rows, mask)
                variance = self._target_variance(outputs, mask)
                terms["target_kl"] = kl.detach()
                terms["target_std"] = variance.sqrt().mean(-1)
                entropy = covariance_entropy(covariance + torch.diag_embed(variance))
                terms["mutual_information"] = entropy - self._over_skips(nlls)
            pairs = zip(self.skips, head_nlls, strict=True)
            terms |= {f"nll_skip_{skip}": nll.detach() for skip, nll in pairs}
        return terms

    def _terms_of_each_pair(self, outputs: dict[str, Tensor], masks: dict[str, Tensor]) -> dict[str, Tensor]:
        """The terms for ``reduction="none"``: likelihoods of pairs, divergences of steps."""
        terms = {}
        if self.residual_variance == "head":
            terms["loss_nll"] = self._pad_pairs("nll", outputs, masks)
        else:
            terms["loss_head"] = self._pad_pairs("nll", outputs, masks)
            profile = self._profile_nlls(outputs, masks)
            terms["loss_nll"] = self._pad_pairs("profile", {**outputs, **profile}, masks)
        latent, log_var = outputs["target"], self._log_var(outputs)
        kl = 0.5 * (latent.square() + log_var.exp() - 1 - log_var).sum(-1)
        terms["loss_target_kl"] = self.target_kl_coeff * self._reduce(
            [kl], [masks.get("steps")], kl.shape[-1]
        )
        return terms

    @staticmethod
    def _log_var(outputs: dict[str, Tensor]) -> Tensor:
        """Log-variances of the targets, broadcastable to the latents ``(*N, B, T, D)``."""
        log_var = outputs["target_log_var"]
        shared = log_var.ndim < outputs["target"].ndim
        return log_var[..., None, None, :] if shared else log_var

    def _scale_divergence(self, outputs: dict[str, Tensor], mask: Tensor | None) -> Tensor:
        r"""Mean over steps of :math:`\sum_d (\sigma_d^2 - 1 - \log \sigma_d^2)`, ``(*N)``."""
        log_var = columns(self._log_var(outputs))
        excess = (log_var.exp() - log_var).sum(-2) - log_var.shape[-2]
        return excess[..., 0, 0] if excess.shape[-2:] == (1, 1) else mean_over(excess.flatten(-2), mask)

    def _target_variance(self, outputs: dict[str, Tensor], mask: Tensor | None) -> Tensor:
        """Mean variance of the targets over steps, ``(*N, D)``."""
        variance = self._log_var(outputs).exp()
        if variance.shape[-3:-1] == (1, 1):
            return variance[..., 0, 0, :]
        return mean_over(variance.flatten(-3, -2).mT, None if mask is None else mask.unsqueeze(-2))

    def _profile(self, outputs: dict[str, Tensor], masks: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        r"""Second moments of the residuals, their inverses, and the constants of the likelihoods.

        At its optimum the covariance has no gradient, so it is a constant here: the gradient is that of
        the profile likelihood, :math:`\frac12 \log\det \mathbb E\, r r^\top`. All skips at once:
        ``(*N, S, D, D)`` twice, and ``(*N, S)``.
        """
        moment = torch.stack(
            [second_moment(outputs[f"residual_{s}"], rows_of(masks.get(str(s)))) for s in self.skips], dim=-3
        )
        with torch.no_grad():
            variance = moment.diagonal(dim1=-2, dim2=-1).mean(-1)
            eye = torch.eye(moment.shape[-1], dtype=moment.dtype, device=moment.device)
            covariance = torch.addcmul(moment, (1e-6 * variance + 1e-12)[..., None, None], eye)
            precision = torch.linalg.inv(covariance)
            constant = torch.logdet(covariance) + moment.shape[-1] * math.log(2 * math.pi)
        return moment, precision, constant

    def _profile_means(self, outputs: dict[str, Tensor], masks: dict[str, Tensor]) -> list[Tensor]:
        """Means of :meth:`_profile_nlls`, which the second moments of the residuals give; each ``(*N)``."""
        moment, precision, constant = self._profile(outputs, masks)
        return list((0.5 * ((precision * moment).sum((-2, -1)) + constant)).unbind(-1))

    def _profile_nlls(self, outputs: dict[str, Tensor], masks: dict[str, Tensor]) -> dict[str, Tensor]:
        """Gaussian likelihoods at the residual covariances that are optimal for the batch; ``(*N, R)``."""
        _, precision, constant = self._profile(outputs, masks)
        nlls = {}
        for i, skip in enumerate(self.skips):
            residual = outputs[f"residual_{skip}"]
            quadratic = (residual @ precision[..., i, :, :] * residual).sum(-1)
            nlls[f"profile_{skip}"] = 0.5 * (quadratic + constant[..., i, None])
        return nlls
