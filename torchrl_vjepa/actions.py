r"""Actions of any specification as flat numbers, and back: the code that models read and planners search."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    TensorSpec,
    Unbounded,
)

__all__ = ["ActionCodec", "ActionEncoder"]

#: Choices of one integer action, at most: each is a number of the code.
MAX_CHOICES = 1024


class _Leaf(NamedTuple):
    """One tensor of the action: how it lies in the code."""

    key: NestedKey
    kind: Literal["number", "bit", "one_hot", "index"]
    shape: torch.Size
    dtype: torch.dtype
    sizes: tuple[int, ...]  # choices of each block, one after the other
    size: int  # numbers in the code


class _Domain(NamedTuple):
    """What the numbers of one tensor may be, each of the size of its code."""

    low: Tensor
    high: Tensor
    allowed: Tensor
    offset: list[int]  # first choice of each block


class ActionCodec(nn.Module):
    r"""Any action specification as a flat code of floats ``(*B, A)``, exactly and back.

    - Continuous actions (``Bounded``, ``Unbounded``) of any rank: themselves, flattened.
    - ``OneHot`` and ``Categorical`` of ``n`` choices: a block of ``n`` numbers, the one-hot code.
    - ``MultiOneHot`` and ``MultiCategorical``: one block after the other; bounded integers too.
    - ``Binary``: one number for each bit.
    - ``Composite`` of several, nested under any keys: their codes, concatenated in the order of the keys.

    So the mean of several codes is a mean of the numbers, a categorical distribution in each block, and a
    probability of each bit: what planners search with. :meth:`decode` takes any such numbers: it clamps
    numbers to their bounds and takes the most probable choice. What it returns has the shapes and dtypes of
    the specification and lies inside.

    A mask of a ``OneHot`` or ``Categorical`` is kept as it is when the codec is made: what it forbids is
    never decoded. Masks that change from step to step are not part of a specification of imagined steps.

    Args:
        spec: the actions, without batch dimensions; a ``Composite`` brings its own keys.
        action_key: the key of what is not a ``Composite``.

    Attributes:
        keys: of the action's tensors, in the order of the code.
        size: numbers ``A`` of the code.
        shape: of one action as a model reads it: that of a single continuous tensor, else ``(A,)``.
        dtype: of the code.
        low: lower bounds ``(A)``; 0 for what is discrete.
        high: upper bounds ``(A)``; 1 for what is discrete.
        allowed: flags ``(A)``; ``False`` for choices that a mask forbids.

    Raises:
        TypeError: if a part of the specification is none of these.
        ValueError: if a mask leaves no choice, or an integer has more than 1024.

    Examples:
        >>> import torch
        >>> from torchrl.data import Bounded, Categorical, Composite
        >>> codec = ActionCodec(Composite(gear=Categorical(3), wheel=Bounded(-1, 1, (2,))))
        >>> code = codec.encode(TensorDict(gear=torch.tensor(1), wheel=torch.tensor([0.5, -0.5])))
        >>> code
        tensor([ 0.0000,  1.0000,  0.0000,  0.5000, -0.5000])
        >>> codec.decode(code)["gear"]
        tensor(1)
        >>> codec.decode(torch.tensor([0.2, 0.1, 0.7, 3.0, 0.0]))["wheel"]
        tensor([1., 0.])
    """

    low: Tensor
    high: Tensor
    allowed: Tensor
    is_choice: Tensor
    is_bit: Tensor
    block: Tensor
    choice: Tensor
    members: Tensor
    forbidden: Tensor
    offset: Tensor

    def __init__(self, spec: TensorSpec, action_key: NestedKey = "action") -> None:
        super().__init__()
        if isinstance(spec, Composite):
            named = [(unravel_key(key), spec[key]) for key in spec.keys(True, True)]
        else:
            named = [(unravel_key(action_key), spec)]
        if not named:
            raise TypeError("the action must hold at least one tensor, got an empty Composite")
        leaves, domains = map(list, zip(*(_leaf(key, leaf) for key, leaf in named), strict=True))
        self._leaves: list[_Leaf] = leaves
        self._sizes = [leaf.size for leaf in leaves]
        self._blocks = [len(leaf.sizes) for leaf in leaves]
        self.keys = [leaf.key for leaf in leaves]
        self.size = sum(self._sizes)
        self.is_continuous = all(leaf.kind == "number" for leaf in leaves)
        #: Whether the code is the action: one continuous tensor.
        self.is_identity = self.is_continuous and len(leaves) == 1
        self.shape = leaves[0].shape if self.is_identity else torch.Size([self.size])
        numbers = [leaf.dtype for leaf in leaves if leaf.kind == "number"]
        self.dtype = numbers[0] if numbers else torch.get_default_dtype()
        for dtype in numbers:
            self.dtype = torch.promote_types(self.dtype, dtype)
        self._register(leaves, domains, named[0][1].device)

    def _register(self, leaves: list[_Leaf], domains: list[_Domain], device: torch.device | None) -> None:
        """The layout of the code as tensors, which move with the module."""
        sizes = [size for leaf in leaves for size in leaf.sizes]
        widest = max(sizes, default=0)
        block, choice = [0] * self.size, [-1] * self.size
        members: list[list[int]] = []
        position = 0
        for leaf in leaves:
            if leaf.kind in ("number", "bit"):
                position += leaf.size
                continue
            for size in leaf.sizes:
                for k in range(size):
                    block[position + k], choice[position + k] = len(members), k
                members.append([position + min(k, size - 1) for k in range(widest)])
                position += size
        kinds = [leaf.kind for leaf in leaves for _ in range(leaf.size)]
        allowed = torch.cat([domain.allowed.cpu() for domain in domains])
        index = torch.tensor(members, dtype=torch.long).reshape(len(members), widest)
        beyond = torch.arange(widest) >= torch.tensor(sizes, dtype=torch.long).unsqueeze(-1)
        forbidden = (beyond | ~allowed[index]) if sizes else torch.zeros(0, 0, dtype=torch.bool)
        if bool(forbidden.all(-1).any()):
            raise ValueError("the mask of the action must leave at least one choice, got none in one block")
        tensors = {
            "low": torch.cat([domain.low.to("cpu", self.dtype) for domain in domains]),
            "high": torch.cat([domain.high.to("cpu", self.dtype) for domain in domains]),
            "allowed": allowed,
            "is_choice": torch.tensor([kind in ("one_hot", "index") for kind in kinds]),
            "is_bit": torch.tensor([kind == "bit" for kind in kinds]),
            "block": torch.tensor(block),
            "choice": torch.tensor(choice),
            "members": index,
            "forbidden": forbidden,
            "offset": torch.tensor(
                [first for domain in domains for first in domain.offset], dtype=torch.long
            ),
        }
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor.to(device), persistent=False)

    def describe(self) -> str:
        """Kinds and keys of the action's tensors, for messages.

        Returns:
            For instance ``"one_hot 'action'"``.
        """
        return ", ".join(f"{leaf.kind} {leaf.key!r}" for leaf in self._leaves)

    def encode(self, actions: TensorDictBase | Tensor) -> Tensor:
        """The code of actions.

        Args:
            actions: a tensordict that holds them under :attr:`keys`, with batch size ``*B``; or, if there is
                one tensor only, that tensor, of shape ``(*B, *shape)``.

        Returns:
            Of shape ``(*B, A)`` and :attr:`dtype`; of the dtype of the actions where they are continuous.

        Raises:
            TypeError: if a tensor is given for several, or a tensordict without the keys.
            ValueError: if a shape does not fit.
        """
        if isinstance(actions, Tensor):
            if len(self.keys) > 1:
                raise TypeError(f"actions must be a tensordict with the keys {self.keys}, got one tensor")
            leaf = self._leaves[0]
            batch = actions.shape[: actions.ndim - len(leaf.shape)]
            return self._encoded(0, actions, batch)
        parts = []
        for number, key in enumerate(self.keys):
            value = actions.get(key, None)
            if value is None:
                raise TypeError(f"actions must hold the keys {self.keys}, missing {key!r}")
            parts.append(self._encoded(number, value, actions.batch_size))
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)

    def _encoded(self, number: int, value: Tensor, batch: torch.Size) -> Tensor:
        leaf = self._leaves[number]
        if tuple(value.shape) != (*batch, *leaf.shape):
            raise ValueError(
                f"{leaf.key!r} must have shape {(*batch, *leaf.shape)}, got {tuple(value.shape)}"
            )
        if leaf.kind != "index":
            flat = value.reshape((*batch, self._sizes[number]))
            return flat if flat.is_floating_point() else flat.to(self.dtype)
        blocks, codes = self._block_slice(number), self._code_slice(number)
        index = value.reshape((*batch, self._blocks[number])) - self.offset[blocks]
        return self._one_hot(index, blocks, codes).to(self.dtype)

    def decode(self, code: Tensor) -> TensorDict:
        """Actions of a code.

        Args:
            code: any finite numbers, of shape ``(*B, A)``; a code, or probabilities.

        Returns:
            A tensordict of batch size ``*B`` with the actions under :attr:`keys`, inside the specification.

        Raises:
            ValueError: if the last dimension is not ``A``.
        """
        leaves = self.decode_leaves(code)
        out = TensorDict({}, batch_size=code.shape[:-1], device=code.device)
        for key, value in zip(self.keys, leaves, strict=True):
            out.set(key, value)
        return out

    def decode_leaves(self, code: Tensor) -> list[Tensor]:
        """As :meth:`decode`, without a tensordict.

        Args:
            code: of shape ``(*B, A)``.

        Returns:
            One tensor for each of :attr:`keys`.

        Raises:
            ValueError: if the last dimension is not ``A``.
        """
        if code.shape[-1:] != (self.size,):
            raise ValueError(f"code must have shape (*B, {self.size}), got {tuple(code.shape)}")
        batch = code.shape[:-1]
        index = self.most_probable(code)
        out = []
        for number, leaf in enumerate(self._leaves):
            blocks, codes = self._block_slice(number), self._code_slice(number)
            if leaf.kind == "number":
                # In the dtype of the action: what is rounded after clamping may lie outside.
                low, high = self.low[codes].to(leaf.dtype), self.high[codes].to(leaf.dtype)
                value = code[..., codes].to(leaf.dtype).clamp(low, high)
            elif leaf.kind == "bit":
                value = code[..., codes] > 0.5
            elif leaf.kind == "one_hot":
                value = self._one_hot(index[..., blocks], blocks, codes)
            else:
                value = index[..., blocks] + self.offset[blocks]
            out.append(value.to(leaf.dtype).reshape((*batch, *leaf.shape)))
        return out

    def executed(self, code: Tensor) -> list[Tensor]:
        """As :meth:`decode_leaves`, for what is a code: one continuous tensor is not clamped again.

        Args:
            code: of shape ``(*B, A)``.

        Returns:
            One tensor for each of :attr:`keys`.
        """
        if self.is_identity and code.dtype == self._leaves[0].dtype:
            return [code.reshape((*code.shape[:-1], *self.shape))]
        return self.decode_leaves(code)

    def most_probable(self, code: Tensor) -> Tensor:
        """The choice of each block that has the largest number, among those that are allowed.

        Args:
            code: of shape ``(*B, A)``.

        Returns:
            Indices of shape ``(*B, K)`` of the ``K`` blocks.
        """
        if not self.members.shape[0]:
            return code.new_zeros((*code.shape[:-1], 0), dtype=torch.long)
        return code[..., self.members].masked_fill(self.forbidden, -math.inf).argmax(dim=-1)

    def mode(self, code: Tensor) -> Tensor:
        """The code of the most probable action: exact one-hots and bits, numbers as they are.

        Args:
            code: of shape ``(*B, A)``.

        Returns:
            Of the same shape and dtype; the same tensor where there is nothing discrete.
        """
        if self.is_continuous:
            return code
        code = torch.where(self.is_bit, (code > 0.5).to(code.dtype), code)
        return self.with_choices(code, self.most_probable(code))

    def with_choices(self, code: Tensor, index: Tensor) -> Tensor:
        """A code in which the blocks are one-hots.

        Args:
            code: of shape ``(*B, A)``.
            index: the choice of each block, of shape ``(*B, K)``.

        Returns:
            Of shape ``(*B, A)``.
        """
        if not self.members.shape[0]:
            return code
        one_hot = index[..., self.block] == self.choice
        return torch.where(self.is_choice, one_hot.to(code.dtype), code)

    def _one_hot(self, index: Tensor, blocks: slice, codes: slice) -> Tensor:
        return index[..., self.block[codes] - blocks.start] == self.choice[codes]

    def _block_slice(self, number: int) -> slice:
        start = sum(self._blocks[:number])
        return slice(start, start + self._blocks[number])

    def _code_slice(self, number: int) -> slice:
        start = sum(self._sizes[:number])
        return slice(start, start + self._sizes[number])


class ActionEncoder(TensorDictModuleBase):
    """Write the code of actions beside them: what models read of multi-categorical and composite actions.

    For windows of a replay buffer (``buffer.append_transform(encoder)``) and in front of a model. Losses
    need it only for such actions: they encode ``OneHot``, ``Binary`` and single ``Categorical`` themselves.

    Args:
        codec: the code.
        out_key: where it is written: the model's ``action_key``.

    Examples:
        >>> import torch
        >>> from torchrl.data import MultiCategorical
        >>> encoder = ActionEncoder(ActionCodec(MultiCategorical([2, 3])))
        >>> encoder(TensorDict(action=torch.tensor([1, 0])))["action_code"]
        tensor([0., 1., 1., 0., 0.])
    """

    def __init__(self, codec: ActionCodec, out_key: NestedKey = "action_code") -> None:
        super().__init__()
        self.codec = codec
        self.in_keys, self.out_keys = list(codec.keys), [unravel_key(out_key)]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the code.

        Args:
            tensordict: holds the actions.

        Returns:
            The same tensordict.
        """
        return tensordict.set(self.out_keys[0], self.codec.encode(tensordict))


def _leaf(key: NestedKey, spec: TensorSpec) -> tuple[_Leaf, _Domain]:
    """How one tensor of the action lies in the code."""
    kinds = (Binary, OneHot, Categorical, Bounded, Unbounded)
    is_number = isinstance(spec, (Bounded, Unbounded))
    if not isinstance(spec, kinds) or (isinstance(spec, Unbounded) and not spec.dtype.is_floating_point):
        raise TypeError(
            "actions must be Bounded or Unbounded (floating point), bounded integers, OneHot, Categorical, "
            f"MultiOneHot, MultiCategorical, Binary or a Composite of them, got {type(spec).__name__} of "
            f"{getattr(spec, 'dtype', None)} under {key!r}"
        )
    shape, dtype = spec.shape, spec.dtype
    total = math.prod(shape)
    if is_number and dtype.is_floating_point:
        low, high = spec.space.low.flatten().clone(), spec.space.high.flatten().clone()
        free = torch.ones(total, dtype=torch.bool)
        return _Leaf(key, "number", shape, dtype, (), total), _Domain(low, high, free, [])
    if isinstance(spec, Binary):
        bit = torch.ones(total)
        return _Leaf(key, "bit", shape, dtype, (), total), _Domain(0 * bit, bit, bit.bool(), [])
    sizes, offset = _choices(key, spec)
    total = sum(sizes)
    mask = None if is_number else getattr(spec, "mask", None)
    allowed = torch.ones(total, dtype=torch.bool)
    if mask is not None:
        lead = shape[:-1] if isinstance(spec, (OneHot, MultiCategorical)) else shape
        allowed = mask.expand(*lead, mask.shape[-1]).reshape(-1)
    kind: Literal["one_hot", "index"] = "one_hot" if isinstance(spec, OneHot) else "index"
    domain = _Domain(torch.zeros(total), torch.ones(total), allowed, offset)
    return _Leaf(key, kind, shape, dtype, sizes, total), domain


def _choices(key: NestedKey, spec: TensorSpec) -> tuple[tuple[int, ...], list[int]]:
    """Number of choices of each block, and the first of them."""
    shape = spec.shape
    if isinstance(spec, Bounded):
        first = spec.space.low.flatten().tolist()
        last = spec.space.high.flatten().tolist()
        sizes = [high - low + 1 for low, high in zip(first, last, strict=True)]
    else:
        if isinstance(spec, MultiOneHot):
            sizes = list(spec.nvec) * math.prod(shape[:-1])
        elif isinstance(spec, MultiCategorical):
            sizes = spec.nvec.expand(shape).flatten().tolist()
        elif isinstance(spec, OneHot):
            sizes = [spec.space.n] * math.prod(shape[:-1])
        else:
            sizes = [spec.space.n] * math.prod(shape)
        first = [0] * len(sizes)
    if any(not 1 <= size <= MAX_CHOICES for size in sizes):
        raise ValueError(
            f"{key!r} must have 1 to {MAX_CHOICES} choices in each of its integers, got {sizes}; make it "
            "continuous and round in the environment"
        )
    return tuple(map(int, sizes)), list(map(int, first))
