"""What carries a belief and the executed action from step to step of an environment."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from torchrl.data import Composite
from torchrl.envs.transforms import TensorDictPrimer

from torchrl_vjepa.actions import ActionCodec

__all__ = ["BeliefPrimer"]


class BeliefPrimer(TensorDictPrimer):
    """Zeros at a reset; besides, writes down the action with which the environment is stepped.

    Args:
        primers: what is carried.
        action: where the executed action is, a tensor of as many numbers as are carried; or its code.
        memory_key: where it is written down.

    Examples:
        >>> from torchrl.data import Categorical, Unbounded
        >>> primer = BeliefPrimer(
        ...     Composite(last=Unbounded((3,))), ActionCodec(Categorical(3)), "last"
        ... )
        >>> primer.memory_key
        'last'
    """

    def __init__(self, primers: Composite, action: NestedKey | ActionCodec, memory_key: NestedKey) -> None:
        super().__init__(primers, expand_specs=True)
        self.codec = action if isinstance(action, ActionCodec) else None
        self.executed_keys = [action] if self.codec is None else self.codec.keys
        self.memory_key = memory_key

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        # Called before the action reaches the transforms below: it is the one of the data. What is
        # under memory_key here is what TensorDictPrimer carries on to the next step.
        tensordict = super()._inv_call(tensordict)
        if all(tensordict.get(key, None) is not None for key in self.executed_keys):
            before = tensordict.get(self.memory_key)
            if self.codec is None:
                executed = tensordict.get(self.executed_keys[0]).reshape(before.shape)
            else:
                executed = self.codec.encode(tensordict)
            tensordict.set(self.memory_key, executed.to(before.dtype))
        return tensordict
