"""Masks of windows against loops over every pair of steps."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracles import pairs_that_count
from tensordict import TensorDict
from torch import Tensor

from torchrl_vjepa.windows import action_chunks, check_finite, pair_mask, read, step_mask


@st.composite
def flags(draw: st.DrawFn) -> tuple[list[list[list[bool]]], int]:
    """done, is_init and mask of a few windows, and a skip that fits."""
    rows, steps = draw(st.integers(1, 3)), draw(st.integers(2, 8))
    row = st.lists(st.booleans(), min_size=steps, max_size=steps)
    columns = [draw(st.lists(row, min_size=rows, max_size=rows)) for _ in range(3)]
    return columns, draw(st.integers(1, steps - 1))


class TestPairMask:
    @given(flags(), st.tuples(st.booleans(), st.booleans(), st.booleans()))
    def test_equals_the_loop(
        self, case: tuple[list[list[list[bool]]], int], present: tuple[bool, bool, bool]
    ) -> None:
        (done, is_init, mask), skip = case
        values = [
            torch.tensor(column) if there else None
            for column, there in zip((done, is_init, mask), present, strict=True)
        ]
        out = pair_mask(*values, skip)
        if not any(present):
            assert out is None
            return
        steps = len(done[0])
        neutral = ([False] * steps, [False] * steps, [True] * steps)
        for i in range(len(done)):
            columns = [
                column[i] if there else default
                for column, there, default in zip((done, is_init, mask), present, neutral, strict=True)
            ]
            assert out[i].tolist() == pairs_that_count(*columns, skip)

    def test_any_batch_dimensions(self) -> None:
        done, is_init, mask = (torch.rand(2, 3, 4, 9) < 0.3 for _ in range(3))
        out = pair_mask(done, is_init, ~mask, 2)
        assert out.shape == (2, 3, 4, 7)
        assert out.dtype == torch.bool
        flat = pair_mask(*(value.reshape(-1, 9) for value in (done, is_init, ~mask)), 2)
        assert torch.equal(out.reshape(-1, 7), flat)
        assert torch.equal(pair_mask(done[0, 0, 0], is_init[0, 0, 0], ~mask[0, 0, 0], 2), out[0, 0, 0])

    def test_done_and_is_init_tell_the_same_story(self) -> None:
        done = torch.rand(20, 12) < 0.2
        is_init = torch.cat([torch.zeros(20, 1, dtype=torch.bool), done[:, :-1]], 1)
        for skip in (1, 2, 5):
            expected = pair_mask(done, None, None, skip)
            assert torch.equal(pair_mask(None, is_init, None, skip), expected)
            assert torch.equal(pair_mask(done, is_init, None, skip), expected)

    @pytest.mark.parametrize("skip", [4, 5])
    def test_a_skip_as_long_as_the_window_has_no_pairs(self, skip: int) -> None:
        ones = torch.ones(2, 4, dtype=torch.bool)
        assert pair_mask(ones, ones, ones, skip).shape == (2, 0)


class TestActionChunks:
    @pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
    @pytest.mark.parametrize("skip", [1, 2, 5])
    def test_equals_the_loop(self, batch: tuple[int, ...], skip: int) -> None:
        action = torch.randn(*batch, 6, 3)
        out = action_chunks(action, skip)
        assert out.shape == (*batch, 6 - skip, skip, 3)
        for t in range(6 - skip):
            for i in range(skip):
                assert torch.equal(out[..., t, i, :], action[..., t + i, :])


class TestStepMask:
    def test_no_mask(self) -> None:
        data = TensorDict(observation=torch.zeros(2, 3, 1), batch_size=(2, 3))
        assert step_mask(data, ["mask", ("collector", "mask")], data.batch_size) is None
        assert step_mask(data, [], data.batch_size) is None

    def test_masks_are_joined_whatever_their_shape_and_dtype(self) -> None:
        batch = torch.Size((2, 4))
        first = torch.tensor([[1, 1, 0, 1], [1, 0, 1, 1]])
        second = torch.tensor([[1.0, 0.0, 1.0, 1.0], [1.0, 1.0, 1.0, 0.0]]).unsqueeze(-1)
        data = TensorDict({"mask": first, "collector": {"mask": second}}, batch_size=batch)
        out = step_mask(data, ["mask", "absent", ("collector", "mask")], batch)
        assert out.dtype == torch.bool
        assert out.tolist() == [[True, False, False, True], [True, False, True, False]]
        assert torch.equal(step_mask(data, ["mask"], batch), first.bool())

    @pytest.mark.parametrize("shape", [(2,), (2, 4, 2), (2, 3), (2, 4, 1, 1)])
    def test_other_shapes_are_refused(self, shape: tuple[int, ...]) -> None:
        data = TensorDict(mask=torch.ones(shape), batch_size=2)
        with pytest.raises(ValueError, match=r"mask 'mask' must have shape \(2, 4\) or \(2, 4, 1\), got"):
            step_mask(data, ["mask"], torch.Size((2, 4)))


class TestCheckFinite:
    @given(
        st.sampled_from([math.nan, math.inf, -math.inf]),
        st.integers(0, 1),
        st.integers(0, 3),
        st.integers(0, 2),
    )
    def test_one_bad_value_is_found_unless_it_is_masked(
        self, bad: float, row: int, step: int, feature: int
    ) -> None:
        value = torch.zeros(2, 4, 3)
        value[row, step, feature] = bad
        mask = torch.ones(2, 4, dtype=torch.bool)
        for present in (None, mask):
            with pytest.raises(ValueError, match="'x' must be finite .* got 1 NaN or infinite values"):
                check_finite(value, present, "x")
        mask[row, step] = False
        check_finite(value, mask, "x")
        mask = ~mask
        with pytest.raises(ValueError, match="'x' must be finite"):
            check_finite(value, mask, "x")

    def test_finite_values_pass_whatever_their_rank(self) -> None:
        mask = torch.tensor([[True, False]])
        for shape in ((1, 2), (1, 2, 3), (1, 2, 3, 4)):
            value = torch.randn(shape)
            check_finite(value, mask, "x")
            value[0, 1] = math.nan
            check_finite(value, mask, "x")
            value[0, 0] = math.nan
            with pytest.raises(ValueError, match=rf"got {math.prod(shape[2:])} NaN"):
                check_finite(value, mask, "x")

    def test_integers_are_finite(self) -> None:
        check_finite(torch.ones(2, 3, dtype=torch.int64), None, "x")

    def test_nested_keys_are_named(self) -> None:
        with pytest.raises(ValueError, match=r"\('next', 'observation'\) must be finite"):
            check_finite(torch.tensor([math.nan]), None, ("next", "observation"))


class TestRead:
    def test_returns_the_entry_itself(self) -> None:
        value: Tensor = torch.zeros(2)
        data = TensorDict({"a": value, "b": {"c": value}}, batch_size=2)
        assert read(data, "a", reader="test") is data["a"]
        assert read(data, ("b", "c"), reader="test") is data["b", "c"]

    def test_a_missing_entry_is_named_with_what_is_there(self) -> None:
        data = TensorDict({"b": {"c": torch.zeros(2)}, "a": torch.zeros(2)}, batch_size=2)
        with pytest.raises(KeyError) as error:
            read(data, ("b", "d"), reader="SomeLoss")
        message = error.value.args[0]
        assert message.startswith("SomeLoss reads the entry ('b', 'd'), which the input lacks")
        assert message.endswith("""it has ["('b', 'c')", 'a']""")
