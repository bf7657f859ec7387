"""Action specifications of every kind, for tests over all of them."""

from __future__ import annotations

import math

import torch
from hypothesis import strategies as st
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

#: One of every kind: name -> specification.
EVERY = {
    "bounded": Bounded(-1, 3, (2,)),
    "matrix": Bounded(-1, 1, (2, 3), dtype=torch.float64),
    "scalar": Bounded(0, 4, ()),
    "unbounded": Unbounded((2,)),
    "one_hot": OneHot(3),
    "one_hot_floats": OneHot(3, dtype=torch.float32),
    "one_hot_integers": OneHot(4, dtype=torch.int64),
    "one_hots": OneHot(3, shape=(2, 3)),
    "categorical": Categorical(3),
    "categorical_vector": Categorical(4, (2,)),
    "multi_one_hot": MultiOneHot([2, 3]),
    "multi_one_hots": MultiOneHot([2, 3], shape=(4, 5)),
    "multi_categorical": MultiCategorical([2, 4]),
    "multi_categoricals": MultiCategorical([2, 3], shape=(2, 2)),
    "binary": Binary(4),
    "binary_matrix": Binary(3, shape=(2, 3), dtype=torch.bool),
    "integers": Bounded(-2, 3, (2,), dtype=torch.int64),
    "masked_one_hot": OneHot(4, mask=torch.tensor([True, False, True, False])),
    "masked_categorical": Categorical(3, mask=torch.tensor([False, False, True])),
    "composite": Composite(
        gear=Categorical(3), body=Composite(wheel=Bounded(-1, 1, (2, 1)), lights=Binary(2, dtype=torch.bool))
    ),
    "two_numbers": Composite(a=Bounded(-1, 1, (2,)), b=Bounded(0, 5, (1,), dtype=torch.float64)),
}


def leaves() -> st.SearchStrategy[TensorSpec]:
    """One tensor of any kind, of small random shape."""
    shape = st.sampled_from([(), (1,), (2,), (2, 1)])
    floats = st.sampled_from([torch.float32, torch.float64])
    integers = st.sampled_from([torch.int64, torch.int32, torch.bool])
    sizes = st.lists(st.integers(1, 4), min_size=1, max_size=3)

    def bounded(low: float, width: float, shape: tuple[int, ...], dtype: torch.dtype) -> TensorSpec:
        return Bounded(low, low + width, shape, dtype=dtype)

    return st.one_of(
        st.builds(bounded, st.floats(-50, 50), st.floats(0.01, 100), shape, floats),
        st.builds(lambda shape, dtype: Unbounded(shape, dtype=dtype), shape, floats),
        st.builds(
            lambda n, d, lead: OneHot(n, shape=(*lead, n), dtype=d), st.integers(1, 5), integers, shape
        ),
        st.builds(lambda n, shape: Categorical(n, shape), st.integers(1, 5), shape),
        st.builds(lambda n: MultiOneHot(n), sizes),
        st.builds(lambda n: MultiCategorical(n), sizes),
        st.builds(lambda n, d: Binary(n, dtype=d), st.integers(1, 4), integers),
        st.builds(
            lambda low, n, shape: Bounded(low, low + n, shape, dtype=torch.int64),
            st.integers(-9, 9),
            st.integers(0, 4),
            shape,
        ),
    )


def specs() -> st.SearchStrategy[TensorSpec]:
    """One tensor, or several under plain and nested keys."""
    both = st.builds(lambda a, b: Composite(left=a, deep=Composite(right=b)), leaves(), leaves())
    three = st.builds(lambda a, b, c: Composite(x=a, y=Composite(z=b, w=c)), leaves(), leaves(), leaves())
    return st.one_of(leaves(), both, three)


def code_size(spec: TensorSpec) -> int:
    """Numbers of the code, counted without the codec."""
    if isinstance(spec, Composite):
        return sum(code_size(spec[key]) for key in spec.keys(True, True))
    numel = math.prod(spec.shape)
    if isinstance(spec, MultiCategorical):
        return int(spec.nvec.expand(spec.shape).sum())
    if isinstance(spec, (Binary, OneHot)) or (
        isinstance(spec, (Bounded, Unbounded)) and spec.dtype.is_floating_point
    ):
        return numel
    if isinstance(spec, Bounded):
        return int((spec.space.high - spec.space.low + 1).sum())
    return numel * spec.space.n
