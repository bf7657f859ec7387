"""Goals: a task that is mapped to where the latent should be."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import TypeAlias

from tensordict import NestedKey, TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Distribution

from torchrl_vjepa.distributions import diag_gaussian
from torchrl_vjepa.priors.arguments import std_vector
from torchrl_vjepa.priors.base import Prior, Task

__all__ = ["GoalPrior"]

Mapper: TypeAlias = TensorDictModuleBase | Callable[[Tensor], Tensor | Distribution]


class GoalPrior(Prior):
    r"""Goal in latent space, :math:`p(Z_T \mid \eta) = \mathcal N(f(\eta), \sigma^2_{\text{goal}} I)`.

    The paper's learned goal prior (section "Inference with Task-Specific Priors"): :math:`f` is the
    frozen target encoder :math:`f_{\theta'}` and :math:`\eta` a goal observation, or :math:`f` is a
    separate mapper from any task input, trained by maximising ``prior(task).log_prob(latent)``.

    Args:
        mapper: :math:`f`: a TensorDictModule that reads one entry and writes the latent first, such as
            ``loss.target_encoder()``; or a callable ``(*B, *task) -> (*B, D)``, or one that returns a
            distribution over latents. ``None``: the task is a latent already.
        std: :math:`\sigma_{\text{goal}}`, a number or ``(D,)``, in units of the latent; ``None`` for a
            mapper that returns a distribution.
        frozen: whether the mapper is a constant. Where its parameters could learn, the prior keeps a
            frozen copy, which later training does not change; gradients with respect to the task pass.
            ``False``: the mapper itself is a part of the prior, and its parameters are the prior's.
            (Of a plain function there is nothing to freeze.) Modes (``eval()``) are the caller's.
        task_key: entry of the task.
        task_ndim: dimensions of one task: 1 for vectors, 3 for images.
        latent_dim: ``D``, checked if given.

    Raises:
        ValueError: if ``std`` is not positive, is missing without a mapper, has another size than the
            latent, or the mapper reads several entries.

    Examples:
        >>> import torch
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_vjepa import JEPA, JEPALoss, Predictor, linear_encoder
        >>> loss = JEPALoss(JEPA(linear_encoder(20, 4), Predictor(4)))
        >>> updater = SoftUpdate(loss, eps=0.99)
        >>> prior = GoalPrior(loss.target_encoder(), std=0.1)
        >>> prior(torch.randn(5, 20)).mean.shape, any(p.requires_grad for p in prior.parameters())
        (torch.Size([5, 4]), False)
        >>> GoalPrior(std=0.1).energy(torch.zeros(3, 2), torch.zeros(2)).shape
        torch.Size([3])
    """

    std: Tensor | None

    def __init__(
        self,
        mapper: Mapper | None = None,
        *,
        std: Tensor | float | None = None,
        frozen: bool = True,
        task_key: NestedKey = "task",
        task_ndim: int = 1,
        latent_dim: int | None = None,
    ) -> None:
        super().__init__(task_key=task_key, task_ndim=task_ndim, latent_dim=latent_dim)
        if mapper is None and std is None:
            raise ValueError("std must be given where the task is a latent, got None")
        if mapper is None and task_ndim != 1:
            raise ValueError(f"task_ndim must be 1 where the task is a latent, got {task_ndim}")
        if mapper is not None and not callable(mapper):
            raise TypeError(f"mapper must be callable or None, got {type(mapper).__name__}")
        if isinstance(mapper, TensorDictModuleBase) and len(mapper.in_keys) != 1:
            raise ValueError(f"mapper must read one entry, the task, got in_keys={mapper.in_keys}")
        if frozen and isinstance(mapper, nn.Module) and any(p.requires_grad for p in mapper.parameters()):
            mapper = copy.deepcopy(mapper).requires_grad_(False)
        self.mapper = mapper
        self.register_buffer("std", None if std is None else std_vector("std", std, latent_dim))

    def forward(self, task: Task = None) -> Distribution:
        """The Gaussian around the goal, or what the mapper returns.

        Args:
            task: of shape ``(*B, *task)``, or a mapping.

        Returns:
            Distribution with batch ``*B`` and event ``(D,)``.

        Raises:
            ValueError: if the task has too few dimensions, the mapper's output another shape, or there
                are two spreads.
            TypeError: if there is no spread.
        """
        value = self.own_task(task)
        if value.ndim < self.task_ndim:
            raise ValueError(
                f"task must have shape (*B, *task) with {self.task_ndim} task dimensions, "
                f"got {tuple(value.shape)}"
            )
        batch = value.shape[: value.ndim - self.task_ndim]
        out = self._mapped(value, batch)
        if isinstance(out, Distribution):
            if self.std is not None:
                raise ValueError("std must be None for a mapper that returns a distribution, got both")
            self._check(tuple(out.batch_shape + out.event_shape), batch)
            return out
        if self.std is None:
            raise TypeError(
                f"mapper must return a distribution where std is None, got {type(out).__name__}; give a std"
            )
        self._check(tuple(out.shape), batch)
        return diag_gaussian(out, self.std.expand(out.shape[-1]))

    def _mapped(self, task: Tensor, batch: tuple[int, ...]) -> Tensor | Distribution:
        if self.mapper is None:
            return task
        if isinstance(self.mapper, TensorDictModuleBase):
            entries = TensorDict({self.mapper.in_keys[0]: task}, batch_size=batch)
            return self.mapper(entries).get(self.mapper.out_keys[0])
        return self.mapper(task)

    def _check(self, shape: tuple[int, ...], batch: tuple[int, ...]) -> None:
        size = self.latent_dim
        if size is None and self.std is not None and self.std.ndim:
            size = len(self.std)
        if shape[:-1] != tuple(batch) or len(shape) != len(batch) + 1 or (size or shape[-1]) != shape[-1]:
            what = "task" if self.mapper is None else "mapper's output"
            raise ValueError(f"{what} must have shape {(*batch, 'D' if size is None else size)}, got {shape}")
