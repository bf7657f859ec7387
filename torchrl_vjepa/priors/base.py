"""What every prior is: from a task to a density over latents."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from typing import TypeAlias

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor, nn
from torch.distributions import Distribution

from torchrl_vjepa.distributions import Density, GaussianFactor

__all__ = ["BoundPrior", "LatentDensity", "Prior", "Task", "check_density"]

#: What a prior is told: its own task, or the entries of a tensordict of which it takes its own.
Task: TypeAlias = Tensor | Mapping[NestedKey, Tensor] | TensorDictBase | None
#: What a prior gives: something with ``log_prob``, normalised or not.
LatentDensity: TypeAlias = Distribution | GaussianFactor | Density


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

    #: Whether its log-density has a gradient; else only planners that sample can use it.
    differentiable: bool = True

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

        Raises:
            ValueError: if the latent has another size than the prior's.
        """
        return self.density(latent.shape[-1] if latent.ndim else 0, task).log_prob(latent)

    def density(self, latent_dim: int, task: Task = None) -> LatentDensity:
        r"""As :meth:`forward`, refused where it is not over latents of a size.

        Args:
            latent_dim: ``D``.
            task: :math:`\eta`.

        Returns:
            The density.

        Raises:
            ValueError: if the prior is over latents of another size.
        """
        density = self(task)
        size = self.latent_dim
        if size is None and not isinstance(density, Density):
            size = density.event_shape[-1]
        if latent_dim != size and (size is not None or not latent_dim):
            raise ValueError(
                f"latent must have last dimension {size} for this {type(self).__name__}, got {latent_dim}"
            )
        return density

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

    def advanced(
        self, tasks: Mapping[NestedKey, Tensor] | TensorDictBase, batch_ndim: int
    ) -> dict[NestedKey, Tensor]:
        r"""The entries of ``in_keys`` that are others one step later: time-indexed tasks, shifted.

        Args:
            tasks: holds the entries of ``in_keys``, with batch ``*B``.
            batch_ndim: how many dimensions ``*B`` has.

        Returns:
            The entries that change; the last task of a sequence is repeated.
        """
        value = None if self.task_key is None else tasks.get(self.task_key, None)
        if value is None or value.ndim == batch_ndim + self.task_ndim:
            return {}
        steps = value.shape[batch_ndim]
        parts = value.narrow(batch_ndim, 1, steps - 1), value.narrow(batch_ndim, steps - 1, 1)
        return {self.task_key: torch.cat(parts, dim=batch_ndim)}

    def bind(self, task: Task) -> BoundPrior:
        """The same prior with its task inside: a prior that takes none.

        The place where a task is looked at: calls with other tasks do not read values, which would make
        a GPU wait.

        Args:
            task: what :meth:`forward` is called with from now on. What changes with time is a
                :class:`TimeIndexedPrior`.

        Returns:
            A prior that shares its parameters with this one.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if the task is not finite, or the density that it gives has no finite moments.
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
        task: its task, or a mapping that holds what the prior reads; kept in buffers, so
            ``.to(device)`` moves it.

    Raises:
        KeyError: if an entry is missing.
        ValueError: if the task is not finite, or the density that it gives has no finite moments.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import GoalPrior
        >>> bound = BoundPrior(GoalPrior(std=0.1), torch.ones(2))
        >>> bound().mean, bound.in_keys
        (tensor([1., 1.]), [])
    """

    def __init__(self, prior: Prior, task: Task) -> None:
        super().__init__(latent_dim=prior.latent_dim)
        self.prior = prior
        self.differentiable = prior.differentiable
        self._keys: list[NestedKey] | None = None
        values: list[Tensor] = []
        if task is None and prior.in_keys:
            raise KeyError(f"task must hold the entries {prior.in_keys}, got None")
        if isinstance(task, Tensor):
            values = [task]
        elif task is not None:
            self._keys = prior.in_keys
            missing = [key for key in self._keys if task.get(key, None) is None]
            if missing:
                raise KeyError(f"task must hold the entries {self._keys}, but lacks {missing}")
            values = [task[key] for key in self._keys]
        for i, value in enumerate(values):
            if not value.isfinite().all():
                raise ValueError(f"task must be finite, got {value.tolist()}")
            self.register_buffer(f"task_{i}", value.detach().clone())
        self._num_tasks = len(values)
        if values or not prior.in_keys:
            check_density(self())

    @property
    def task(self) -> Task:
        """The task that is fixed."""
        values = [self.get_buffer(f"task_{i}") for i in range(self._num_tasks)]
        if self._keys is not None:
            return dict(zip(self._keys, values, strict=True))
        return values[0] if values else None

    def forward(self, task: Task = None) -> LatentDensity:
        """The density of the task that is fixed.

        Args:
            task: not used.

        Returns:
            The density.
        """
        return self.prior(self.task)


def check_density(density: LatentDensity) -> None:
    """Refuse a density whose moments overflow: contradictory or far too sharp experts.

    Reads values, so it is for constructors and :meth:`Prior.bind`.

    Args:
        density: of any kind; energies are not looked at.

    Raises:
        ValueError: if a mean, standard deviation or precision is not finite, or a deviation is zero.

    Examples:
        >>> import torch
        >>> from torchrl_vjepa import diag_gaussian
        >>> check_density(diag_gaussian(torch.zeros(2), torch.tensor([1.0, 0.0])))
        Traceback (most recent call last):
        ...
        ValueError: the prior's moments must be finite and its spread positive, ...
    """
    if isinstance(density, Density):
        if density.base is not None:
            check_density(density.base)
        return
    if isinstance(density, GaussianFactor):
        sound = density.precision.isfinite().all() and density.information.isfinite().all()
    else:
        try:
            mean, std = density.mean, density.stddev
        except NotImplementedError:  # not every distribution knows them
            return
        # An infinite variance is no defect: heavy tails have it.
        sound = mean.isfinite().all() and (std > 0).all() and std.pow(-2).isfinite().all()
    if not sound:
        raise ValueError(
            "the prior's moments must be finite and its spread positive, but in this dtype they overflow: "
            "the experts are too sharp, or contradict each other; widen a std or lower a weight"
        )
