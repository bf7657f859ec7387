"""What every prior is: from a task to a density over latents."""

from __future__ import annotations

import abc
from collections.abc import Mapping

from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor, nn
from torch.distributions import Distribution

from torchrl_vjepa.distributions import Density, GaussianFactor

__all__ = ["BoundPrior", "LatentDensity", "Prior", "Task"]

#: What a prior is told: its own task, or the entries of a tensordict of which it takes its own.
Task = Tensor | Mapping[NestedKey, Tensor] | TensorDictBase | None
#: What a prior gives: something with ``log_prob``, normalised or not.
LatentDensity = Distribution | GaussianFactor | Density


class Prior(nn.Module, abc.ABC):
    r"""Latent-space prior :math:`p_{\text{prior}}(Z_T \mid \eta)` (``eq:bjepa_prior``), a modular expert.

    Called with a task :math:`\eta` it gives a density over latents. A subclass gives :meth:`forward`;
    everything else in the library (:class:`~torchrl_vjepa.predictor.FusedPredictor`,
    :class:`~torchrl_vjepa.envs.LatentEnv`, :class:`ProductPrior`, losses) goes through it.

    **Where tasks come from.** A task is a tensor of ``task_ndim`` dimensions behind any batch
    dimensions, which broadcast against those of the latents: every row may have its own. In a tensordict
    it is the entry ``task_key``, with ``*B`` in front, or ``(*B, H)``: then it is time-indexed,
    :math:`\eta_{t+1}, \dots, \eta_{t+H}`. Priors without a task (``task_key=None``) ignore what they get.

    Args:
        task_key: entry of the task; ``None`` for a prior that takes none.
        task_ndim: dimensions of one task: 1 for vectors, 3 for images.
        latent_dim: size ``D`` of the latent, where the prior knows it.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import diag_gaussian
        >>> class Around(Prior):
        ...     def forward(self, task=None):
        ...         return diag_gaussian(self.own_task(task), torch.ones(1))
        >>> prior = Around(task_key="goal")
        >>> prior.energy(torch.ones(7, 2), torch.zeros(2)).shape
        torch.Size([7])
        >>> prior.along({"goal": torch.zeros(5, 2)}, batch_ndim=1, horizon=3)["goal"].shape
        torch.Size([5, 1, 2])
    """

    def __init__(
        self, *, task_key: NestedKey | None = None, task_ndim: int = 1, latent_dim: int | None = None
    ) -> None:
        super().__init__()
        self.task_key = None if task_key is None else unravel_key(task_key)
        self.task_ndim, self.latent_dim = task_ndim, latent_dim

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries of a tensordict that the prior reads."""
        return [] if self.task_key is None else [self.task_key]

    @abc.abstractmethod
    def forward(self, task: Task = None) -> LatentDensity:
        r"""The density :math:`p_{\text{prior}}(\cdot \mid \eta)`.

        Args:
            task: :math:`\eta`, or a mapping that holds it under ``task_key``.

        Returns:
            A distribution, or an unnormalised density; its batch dimensions are those of the task.
        """

    def log_prob(self, latent: Tensor, task: Task = None) -> Tensor:
        r"""Log-density :math:`\log p_{\text{prior}}(Z \mid \eta)`, up to a constant.

        Args:
            latent: of shape ``(*B, D)``.
            task: :math:`\eta`.

        Returns:
            ``(*B)``, in nats.
        """
        return self(task).log_prob(latent)

    def energy(self, latent: Tensor, task: Task = None) -> Tensor:
        r"""Energy :math:`E(Z; \eta) = -\log p_{\text{prior}}(Z \mid \eta)`, up to a constant.

        Args:
            latent: of shape ``(*B, D)``.
            task: :math:`\eta`.

        Returns:
            ``(*B)``, in nats.
        """
        return -self.log_prob(latent, task)

    def along(
        self, tasks: Mapping[NestedKey, Tensor] | TensorDictBase, batch_ndim: int, horizon: int
    ) -> dict[NestedKey, Tensor]:
        r"""Tasks of the next steps, :math:`\eta_{t+1}, \dots, \eta_{t+H}`.

        Args:
            tasks: holds the entries of ``in_keys``, with batch ``*B``.
            batch_ndim: how many dimensions ``*B`` has.
            horizon: :math:`H`.

        Returns:
            The entries with a time dimension behind ``*B``: of size ``H``, or 1 where the task is constant.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if it has too few dimensions, or fewer steps than ``H``.
        """
        if self.task_key is None:
            return {}
        value = tasks.get(self.task_key, None)
        if value is None:
            raise KeyError(
                f"{type(self).__name__} reads its task from the entry {self.task_key!r}, which is missing; "
                "put it there, or use bind(task)"
            )
        extra = value.ndim - batch_ndim - self.task_ndim
        if extra not in (0, 1):
            raise ValueError(
                f"{self.task_key!r} must have shape (*B, *task) or (*B, H, *task) with {batch_ndim} batch "
                f"and {self.task_ndim} task dimensions, got {tuple(value.shape)}"
            )
        if not extra:
            return {self.task_key: value.unsqueeze(batch_ndim)}
        if value.shape[batch_ndim] < horizon:
            raise ValueError(
                f"{self.task_key!r} must hold the tasks of at least {horizon} steps, got "
                f"{value.shape[batch_ndim]} in shape {tuple(value.shape)}"
            )
        return {self.task_key: value.narrow(batch_ndim, 0, horizon)}

    def bind(self, task: Task) -> BoundPrior:
        """The same prior with its task inside: a prior that takes none.

        Args:
            task: what :meth:`forward` is called with from now on.

        Returns:
            A prior that shares its parameters with this one.
        """
        return BoundPrior(self, task)

    def own_task(self, task: Task) -> Tensor:
        """The tensor that is meant for this prior.

        Args:
            task: it, or a mapping that holds it under ``task_key``.

        Returns:
            The task.

        Raises:
            KeyError: if the mapping does not hold it.
            ValueError: if there is none.
        """
        if isinstance(task, Tensor):
            return task
        if task is None:
            raise ValueError(
                f"task must be given to {type(self).__name__}, got None; call it with one, bind(task), or "
                f"put the entry {self.task_key!r} into the tensordict"
            )
        value = task.get(self.task_key, None)
        if value is None:
            raise KeyError(
                f"{type(self).__name__} needs the entry {self.task_key!r}, got {list(task.keys())}"
            )
        return value


class BoundPrior(Prior):
    """A prior whose task is fixed: what :meth:`Prior.bind` gives.

    Args:
        prior: the prior.
        task: its task; a buffer if it is one tensor, so ``.to(device)`` moves it.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import GaussianPrior
        >>> bound = BoundPrior(GaussianPrior(2), None)
        >>> bound.energy(torch.zeros(2)).shape
        torch.Size([])
    """

    def __init__(self, prior: Prior, task: Task) -> None:
        super().__init__(latent_dim=prior.latent_dim)
        self.prior = prior
        if isinstance(task, Tensor):
            self.register_buffer("task", task.detach().clone())
        else:
            self.task = task

    def forward(self, task: Task = None) -> LatentDensity:
        """The density of the task that is fixed.

        Args:
            task: not used.

        Returns:
            The density.
        """
        return self.prior(self.task)
