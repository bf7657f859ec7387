"""Tasks that change with time, and reference paths."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torchrl_vjepa.priors.arguments import as_constant
from torchrl_vjepa.priors.base import LatentDensity, Prior, Task, check_density
from torchrl_vjepa.priors.goal import GoalPrior

__all__ = ["TimeIndexedPrior", "trajectory_prior"]


class TimeIndexedPrior(Prior):
    r"""A prior whose task is a function of time, :math:`p_{\text{prior}}(Z_t \mid \eta_t)`.

    Its own task is the time :math:`t`, which TorchRL's ``StepCounter`` writes: ``tasks[t]`` is meant for
    the latent at step count :math:`t`, so from a state at :math:`t` the next latents meet
    ``tasks[t + 1]``, ..., ``tasks[t + H]``.

    Args:
        prior: what the tasks are for.
        tasks: :math:`\eta_0, \dots, \eta_{T-1}`, of shape ``(T, *task)``.
        time_key: entry of the time: integers ``(*B, 1)``.
        periodic: whether ``tasks`` begins again after its end; else its last one holds from then on.

    Raises:
        ValueError: if the prior takes no task or several, or the tasks are not finite or have another
            number of dimensions.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import GoalPrior
        >>> ramp = TimeIndexedPrior(GoalPrior(std=0.1), torch.arange(4.0).unsqueeze(-1))
        >>> ramp(torch.tensor([[0], [2], [9]])).mean.squeeze(-1)
        tensor([0., 2., 3.])
        >>> ramp.along({"step_count": torch.tensor([1])}, batch_ndim=0, horizon=3)
        {'step_count': tensor([[2],
                [3],
                [4]])}
    """

    tasks: Tensor

    def __init__(
        self, prior: Prior, tasks: Tensor, *, time_key: NestedKey = "step_count", periodic: bool = False
    ) -> None:
        super().__init__(task_key=time_key, latent_dim=prior.latent_dim)
        if prior.task_key is None:
            raise ValueError(
                f"prior must take one task, got in_keys={prior.in_keys}; index each expert of a product"
            )
        if tasks.ndim != 1 + prior.task_ndim or not len(tasks) or not tasks.isfinite().all():
            raise ValueError(
                f"tasks must be finite with shape (T, *task), T > 0, and {prior.task_ndim} task dimensions, "
                f"got {tuple(tasks.shape)}"
            )
        self.prior, self.periodic = prior, periodic
        self.differentiable = prior.differentiable
        self.register_buffer(
            "tasks", as_constant(tasks) if tasks.is_floating_point() else tasks.detach().clone()
        )
        check_density(self(torch.arange(len(tasks), device=tasks.device).unsqueeze(-1)))

    def forward(self, task: Task = None) -> LatentDensity:
        """The density of the task at a time.

        Args:
            task: the time, integers of shape ``(*B, 1)``, or a mapping.

        Returns:
            Density with batch ``*B``.

        Raises:
            ValueError: if the time has another shape, or is no integer.
        """
        time = self.own_task(task)
        if time.ndim == 0 or time.shape[-1] != 1 or time.is_floating_point() or time.dtype == torch.bool:
            raise ValueError(
                f"task must be the time, integers of shape (*B, 1), got {time.dtype} {tuple(time.shape)}"
            )
        last = len(self.tasks) - 1
        index = time.squeeze(-1).long()
        index = index.remainder(last + 1) if self.periodic else index.clamp(0, last)
        return self.prior(self.tasks[index])

    def along(
        self, tasks: Mapping[NestedKey, Tensor] | TensorDictBase, batch_ndim: int, horizon: int
    ) -> dict[NestedKey, Tensor]:
        r"""The times :math:`t + 1, \dots, t + H`.

        Args:
            tasks: holds the time :math:`t`, ``(*B, 1)``; or the times of the next steps, ``(*B, H, 1)``.
            batch_ndim: how many dimensions ``*B`` has.
            horizon: :math:`H`.

        Returns:
            The entry with a time dimension of size ``H`` behind ``*B``.

        Raises:
            KeyError: if the entry is missing.
            ValueError: if it has too few dimensions, or fewer steps than ``H``.
        """
        ((key, time),) = super().along(tasks, batch_ndim, horizon).items()
        if tasks[key].ndim > batch_ndim + 1:
            return {key: time}
        return {key: time + torch.arange(1, horizon + 1, device=time.device).unsqueeze(-1)}

    def advanced(
        self, tasks: Mapping[NestedKey, Tensor] | TensorDictBase, batch_ndim: int
    ) -> dict[NestedKey, Tensor]:
        """The time one step later.

        Args:
            tasks: holds the time, ``(*B, 1)`` or ``(*B, H, 1)``.
            batch_ndim: how many dimensions ``*B`` has.

        Returns:
            The entry, one larger, or shifted.
        """
        time = None if self.task_key is None else tasks.get(self.task_key, None)
        if self.task_key is None or time is None or time.ndim != batch_ndim + 1:
            return super().advanced(tasks, batch_ndim)
        return {self.task_key: time + 1}


def trajectory_prior(
    path: Tensor,
    std: Tensor | float,
    *,
    time_key: NestedKey = "step_count",
    periodic: bool = False,
) -> TimeIndexedPrior:
    r"""Stay close to a reference trajectory: a quadratic well :math:`\mathcal N(r_t, \sigma^2 I)` along it.

    The paper's example of an analytic prior (section "Inference with Task-Specific Priors").

    Args:
        path: :math:`r_0, \dots, r_{T-1}`, of shape ``(T, D)``.
        std: :math:`\sigma`, a number or ``(D,)``.
        time_key: entry of the time.
        periodic: whether the path is a closed curve; else it ends in its last point.

    Returns:
        A prior of the time.

    Raises:
        ValueError: if the path is not finite or no matrix, or ``std`` is not positive.

    Examples:
        >>> import torch
        >>> angle = torch.arange(8) * torch.pi / 4
        >>> circle = trajectory_prior(torch.stack([angle.cos(), angle.sin()], -1), 0.1, periodic=True)
        >>> circle(torch.tensor([[8]])).mean
        tensor([[1., 0.]])
    """
    if path.ndim != 2:
        raise ValueError(f"path must have shape (T, D), got {tuple(path.shape)}")
    goal = GoalPrior(std=std, latent_dim=path.shape[1])
    return TimeIndexedPrior(goal, path, time_key=time_key, periodic=periodic)
