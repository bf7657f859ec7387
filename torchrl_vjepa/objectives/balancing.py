"""Adaptive coefficients: beta and gamma as multipliers of a constraint in nats."""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.objectives.common import LossModule

__all__ = ["AdaptiveCoefficient"]


class AdaptiveCoefficient:
    r"""Moves a coefficient of a loss so that a diagnostic stays at its target, by dual ascent.

    The paper asks for "adaptive mechanisms for balancing these terms" (section "Limitations", paragraph
    "Optimization Dynamics"): :math:`\beta` and :math:`\gamma` weigh KL divergences against a likelihood
    whose scale changes as the representation forms, so no constant fits all of a training run. What one
    can say in advance is how many nats a divergence :math:`K` may have. That is a constraint, and the
    coefficient is its multiplier:

    .. math::
        \min_\theta \max_{\lambda > 0}\; \mathcal L(\theta)
        + \lambda \big(K(\theta) - K_{\text{target}}\big), \qquad
        \log\lambda \leftarrow \log\lambda + \eta\, e_t + \kappa\, (e_t - e_{t-1}), \qquad
        e_t = \mathrm{clip}\Big(\frac{K - K_{\text{target}}}{|K_{\text{target}}|}, -1, 1\Big)

    (exponentiated gradient: :math:`\lambda` stays positive), clamped to ``bounds``. Where the constraint
    is slack, :math:`\lambda` falls to the lower bound. The term with :math:`\kappa` changes no fixed
    point; it damps the oscillation between model and multiplier, as the proportional part of a
    controller does. :math:`\eta` should be small beside the rate at which the model learns.

    Used next to the optimizer, like :class:`~torchrl.objectives.SoftUpdate`: :meth:`step` after
    ``backward()``. The coefficient is the loss's own buffer: it can be read and set there, and
    ``loss.state_dict()`` holds it. Of a loss with a list of models every model gets its own: the buffer
    gets shape ``(num_models,)``.

    What moves the diagnostic must be the coefficient: :math:`\beta` of
    :class:`~torchrl_vjepa.VJEPALoss` trades the scale of the target against the likelihood with
    ``target_scale_gradient="both"`` only (with ``"kl"`` nothing opposes it: the scale tends to 1 for
    every :math:`\beta`).

    Args:
        loss: a loss with schedulable coefficients; of this package, or TorchRL's own.
        coefficient: name of the coefficient, such as ``"target_kl_coeff"`` or ``"structural_kl_coeff"``.
        diagnostic: the entry of the losses that is to stay at its target, without the coefficient, such as
            ``"target_kl"`` or ``"structural_kl"``.
        target: :math:`K_{\text{target}}`, in the unit of the diagnostic (nats, for a divergence); not 0.
            An attribute that may be changed during training.
        rate: :math:`\eta`. An attribute, too.
        damping: :math:`\kappa`.
        bounds: least and greatest value of the coefficient.
        limit: ``"upper"``: a larger coefficient lowers the diagnostic, which may be at most the target;
            ``"lower"``: a larger coefficient raises it, and it should be at least the target (an entropy or
            an effective rank).

    Raises:
        ValueError: if the loss has no such coefficient or entry, an entry is a ``loss_*`` (weighted by
            its coefficient), a number is out of range, or the coefficient starts outside of ``bounds``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_vjepa import VJEPA, Predictor, VJEPALoss, linear_encoder
        >>> loss = VJEPALoss(VJEPA(linear_encoder(20, 4), Predictor(4)), target_scale_gradient="both")
        >>> updater = SoftUpdate(loss, eps=0.99)
        >>> balancer = AdaptiveCoefficient(loss, "target_kl_coeff", "target_kl", target=8.0, rate=0.1)
        >>> losses = loss(TensorDict(observation=torch.randn(8, 5, 20), batch_size=(8, 5)))
        >>> sum(v for k, v in losses.items() if k.startswith("loss_")).backward()
        >>> updater.step()
        >>> balancer.step(losses)  # the KL is less than allowed here, so beta falls
        >>> losses["target_kl"] < 8.0, loss.target_kl_coeff < 0.01
        (tensor(True), tensor(True))
    """

    def __init__(
        self,
        loss: LossModule,
        coefficient: str,
        diagnostic: NestedKey,
        target: float,
        *,
        rate: float = 0.01,
        damping: float = 1.0,
        bounds: tuple[float, float] = (1e-6, 1e4),
        limit: Literal["upper", "lower"] = "upper",
    ) -> None:
        schedulable = sorted(
            name for name in type(loss)._all_schedulable_buffers if getattr(loss, name, None) is not None
        )
        if coefficient not in schedulable:
            raise ValueError(
                f"coefficient must be one of {schedulable} for {type(loss).__name__}, got {coefficient!r}"
            )
        entries = [key for key in loss.out_keys if not str(key).startswith("loss_")]
        if diagnostic not in entries:
            raise ValueError(
                f"diagnostic must be an entry of the losses that no coefficient weighs, one of {entries} for "
                f"{type(loss).__name__} as it is, got {diagnostic!r}"
            )
        if not (math.isfinite(target) and target):
            raise ValueError(f"target must be finite and not 0, got {target}")
        if not (math.isfinite(rate) and rate > 0):
            raise ValueError(f"rate must be finite and positive, got {rate}")
        if not (math.isfinite(damping) and damping >= 0):
            raise ValueError(f"damping must be finite and at least 0, got {damping}")
        low, high = bounds
        if not (0 < low < high and math.isfinite(high)):
            raise ValueError(f"bounds must be finite (low, high) with 0 < low < high, got {bounds}")
        if limit not in ("upper", "lower"):
            raise ValueError(f"limit must be 'upper' or 'lower', got {limit!r}")
        value: Tensor = getattr(loss, coefficient)
        if not bool(((value >= low) & (value <= high)).all()):
            raise ValueError(
                f"{coefficient} must start within bounds={bounds} (its steps multiply it), "
                f"got {value.tolist()}"
            )
        num_models = getattr(loss, "num_models", None)
        if num_models is not None and not value.ndim:
            loss.register_buffer(coefficient, value.repeat(num_models))
        self.loss = loss
        self.coefficient = coefficient
        self.diagnostic = diagnostic
        self.target = float(target)
        self.rate = float(rate)
        self.damping = float(damping)
        self.bounds = (float(low), float(high))
        self.limit = limit
        self._excess: Tensor | None = None  # of the last step

    @torch.no_grad()
    def step(self, losses: TensorDictBase) -> None:
        """Move the coefficient one step; it waits for no device.

        A diagnostic that is not a number moves nothing.

        Args:
            losses: what the loss returned, after ``backward()``: the coefficient is changed in place.

        Raises:
            KeyError: if the diagnostic is missing.
            ValueError: if the diagnostic is neither a scalar nor one number for each model.
        """
        value = losses.get(self.diagnostic, None)
        if value is None:
            raise KeyError(f"losses must hold {self.diagnostic!r}, got {sorted(map(str, losses.keys()))}")
        multiplier: Tensor = getattr(self.loss, self.coefficient)
        if value.shape != multiplier.shape:
            raise ValueError(
                f"{self.diagnostic!r} must have the shape {tuple(multiplier.shape)} of "
                f"{self.coefficient}, got {tuple(value.shape)}"
            )
        excess = (value.detach() - self.target) / abs(self.target)
        if self.limit == "lower":
            excess = -excess
        excess = excess.clamp(-1.0, 1.0)
        change = torch.zeros_like(excess) if self._excess is None else excess - self._excess
        # What is not a number moves nothing, now or in the next step.
        growth = (self.rate * excess + self.damping * change).nan_to_num(0.0).exp()
        multiplier.copy_((multiplier * growth).clamp(*self.bounds))
        self._excess = excess

    def state_dict(self) -> dict[str, Any]:
        """What a training run changes: the coefficient, the last excess, the target and the rate.

        Returns:
            A dictionary for :meth:`load_state_dict`.
        """
        multiplier: Tensor = getattr(self.loss, self.coefficient)
        return {
            "coefficient": multiplier.clone(),
            "excess": self._excess,
            "target": self.target,
            "rate": self.rate,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Resume.

        Args:
            state_dict: from :meth:`state_dict`.

        Raises:
            ValueError: if it holds other entries, or the coefficient has another shape.
        """
        expected = {"coefficient", "excess", "rate", "target"}
        if set(state_dict) != expected:
            raise ValueError(f"state_dict must hold {sorted(expected)}, got {sorted(state_dict)}")
        multiplier: Tensor = getattr(self.loss, self.coefficient)
        if state_dict["coefficient"].shape != multiplier.shape:
            raise ValueError(
                f"state_dict must hold a coefficient of shape {tuple(multiplier.shape)}, "
                f"got {tuple(state_dict['coefficient'].shape)}"
            )
        multiplier.copy_(state_dict["coefficient"])
        excess: Tensor | None = state_dict["excess"]
        self._excess = None if excess is None else excess.to(multiplier.device)
        self.target, self.rate = float(state_dict["target"]), float(state_dict["rate"])
