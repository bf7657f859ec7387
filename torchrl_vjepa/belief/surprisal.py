"""Surprise: how unlikely the model finds what was observed."""

from __future__ import annotations

from torch import Tensor

from torchrl_vjepa.belief.rollouts import Transition
from torchrl_vjepa.distributions import Delta

__all__ = ["surprise"]


def surprise(transition: Transition, latents: Tensor, actions: Tensor) -> Tensor:
    r"""Negative log-density of the latent that was actually observed, at every step.

    .. math::
        s_t = -\log p_\phi(Z_{t+1} \mid Z_t, u_t), \qquad Z_t = f_\theta(x_t)

    An anomaly signal: while the system is what the model learned, its mean is the predictive entropy
    (:math:`\tfrac D2 \log 2 \pi e + \sum_i \log \sigma_i` for a diagonal Gaussian); a changed dynamics or a
    broken sensor raises it, a distractor that the encoder ignores does not. Calibrate a threshold on
    held-out data. The surprise of an observation under a filtered belief, which forgives a latent that
    was uncertain before, is minus the ``log_evidence`` of :class:`ParticleFilter`.

    Args:
        transition: ``(latent (*B, D), action (*B, A)) -> Distribution``, for instance ``Predictor.dist``.
        latents: encoded trajectories, each of one episode, of shape ``(*B, T, D)``, ``T`` of at least 2.
        actions: of shape ``(*B, T, A)``, ``u_t`` moving step ``t`` to ``t + 1``: the last one is not
            used; or ``(*B, T - 1, A)``.

    Returns:
        Surprise in nats, of shape ``(*B, T - 1)``; entry ``t`` is known at step ``t + 1``.

    Raises:
        ValueError: if shapes disagree, a latent is not finite, or the transition is deterministic: a
            point mass has no density.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa.distributions import diag_gaussian
        >>> def walk(latent, action):
        ...     return diag_gaussian(latent + action, 0.1 * torch.ones(1))
        >>> latents = torch.tensor([[0.0], [1.0], [2.0], [7.0]])  # the last step is five units too long
        >>> surprise(walk, latents, torch.ones(4, 1))
        tensor([  -1.3836,   -1.3836,  798.6163])
    """
    num_steps = latents.shape[-2] if latents.ndim > 1 else 0
    if num_steps < 2:
        raise ValueError(
            f"latents must have shape (*B, T, D) with T of at least 2, got {tuple(latents.shape)}"
        )
    if actions.shape[:-1] not in (latents.shape[:-1], (*latents.shape[:-2], num_steps - 1)):
        raise ValueError(
            f"actions must have shape (*B, T, A) or (*B, T - 1, A) for latents {tuple(latents.shape)}, got "
            f"{tuple(actions.shape)}"
        )
    if not latents.isfinite().all():
        raise ValueError("latents must be finite, got NaN or infinite entries")
    p = transition(latents[..., :-1, :], actions[..., : num_steps - 1, :])
    if isinstance(p, Delta):
        raise ValueError("transition must have a density, got a point mass: use a probabilistic head")
    return -p.log_prob(latents[..., 1:, :])
