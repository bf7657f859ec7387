"""What a predictor and its fusion with a prior share."""

from __future__ import annotations

import abc
from typing import Any, Literal

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.distributions import Distribution

from torchrl_vjepa.distributions import point_estimate
from torchrl_vjepa.windows import read

__all__ = ["PredictiveModel"]


class PredictiveModel(TensorDictModuleBase):
    """``dist`` as a TensorDictModule: what a predictor and its fusion with a prior share.

    Examples:
        >>> from torchrl_vjepa import FusedPredictor, Predictor
        >>> all(issubclass(model, PredictiveModel) for model in (FusedPredictor, Predictor))
        True
    """

    latent_dim: int
    action_dim: int
    side_info_dim: int
    skips: tuple[int, ...]
    how: Literal["mean", "mode", "sample"]
    latent_key: NestedKey
    action_key: NestedKey
    side_info_key: NestedKey

    @abc.abstractmethod
    def dist(
        self,
        latent: Tensor,
        action: Tensor | None = None,
        *,
        skip: int = 1,
        side_info: Tensor | None = None,
    ) -> Distribution:
        """The distribution of the latent ``skip`` steps ahead; a member gives it.

        Args:
            latent: of shape ``(*B, D)``.
            action: of shape ``(*B, skip, A)``, or ``(*B, A)`` for ``skip=1``.
            skip: how many steps ahead.
            side_info: of shape ``(*B, S)``.

        Returns:
            Distribution with batch ``*B`` and event ``(D,)``.
        """

    def dist_of(self, tensordict: TensorDictBase) -> Distribution:
        """The one-step predictive distribution of what ``in_keys`` names.

        Args:
            tensordict: holds ``latent`` and what else ``in_keys`` names.

        Returns:
            Distribution with batch ``*B`` and event ``(D,)``.

        Raises:
            KeyError: if an entry is missing.
        """
        return self.dist(**self._inputs(tensordict))

    def _inputs(self, tensordict: TensorDictBase) -> dict[str, Any]:
        """The arguments of :meth:`dist` that are in a tensordict."""
        latent, *rest = (read(tensordict, key, reader=type(self).__name__) for key in self.in_keys)
        return {
            "latent": latent,
            "action": rest.pop(0) if self.action_dim else None,
            "side_info": rest.pop(0) if self.side_info_dim else None,
        }

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the one-step point prediction.

        Args:
            tensordict: holds ``latent`` and what else ``in_keys`` names.

        Returns:
            The same tensordict with the entry ``out_keys[0]``.

        Raises:
            KeyError: if an entry is missing.
        """
        p = self.dist_of(tensordict)
        return tensordict.set(self.out_keys[0], point_estimate(p, self.how))
