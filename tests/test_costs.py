"""Costs against brute force, and the quadratic reward head against its definition."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_vjepa.costs import (
    Cost,
    QuadraticReward,
    action_cost,
    quadratic_cost,
)


def plain_cost(latent: Tensor, action: Tensor) -> Tensor:
    return latent[..., 0] * 2.0 + action[..., 0]


class TestQuadraticCost:
    @pytest.mark.parametrize("kind", ["none", "number", "diagonal", "matrix"])
    def test_equals_the_definition(self, kind: str) -> None:
        target = torch.randn(3, dtype=torch.float64)
        root = torch.randn(3, 3, dtype=torch.float64)
        weight, matrix = {
            "none": (None, torch.eye(3)),
            "number": (2.5, 2.5 * torch.eye(3)),
            "diagonal": (torch.tensor([1.0, 2.0, 3.0]), torch.diag(torch.tensor([1.0, 2.0, 3.0]))),
            "matrix": (root @ root.mT, root @ root.mT),
        }[kind]
        latent = torch.randn(4, 5, 3, dtype=torch.float64)
        cost = quadratic_cost(target, weight)(latent, torch.zeros(4, 5, 1))
        for i in range(4):
            for j in range(5):
                e = latent[i, j] - target
                assert torch.allclose(cost[i, j], e @ matrix.double() @ e)

    def test_only_the_symmetric_part_of_a_matrix_counts(self) -> None:
        skewed = torch.tensor([[1.0, 2.0], [0.0, 1.0]])
        symmetric = torch.tensor([[1.0, 1.0], [1.0, 1.0]])
        latent = torch.randn(6, 2)
        torch.testing.assert_close(
            quadratic_cost(torch.zeros(2), skewed)(latent, latent),
            quadratic_cost(torch.zeros(2), symmetric)(latent, latent),
        )

    def test_gradient_is_twice_the_weighted_difference(self) -> None:
        target, weight = torch.randn(3), torch.tensor([1.0, 0.5, 2.0])
        latent = torch.randn(3, requires_grad=True)
        quadratic_cost(target, weight)(latent, torch.zeros(1)).backward()
        torch.testing.assert_close(latent.grad, 2 * weight * (latent.detach() - target))

    def test_does_not_follow_later_changes_of_the_target(self) -> None:
        target = torch.zeros(2)
        cost = quadratic_cost(target)
        target.fill_(100.0)
        assert cost(torch.zeros(2), torch.zeros(1)) == 0

    @pytest.mark.parametrize(
        ("target", "weight", "message"),
        [
            (torch.zeros(()), None, r"target must have shape \(D,\)"),
            (torch.zeros(2, 3), None, r"target must have shape \(D,\)"),
            (torch.tensor([0.0, torch.nan]), None, "target must be finite"),
            (torch.zeros(2), torch.ones(3), r"n=2, got shape \(3,\)"),
            (torch.zeros(2), torch.ones(2, 3), r"got shape \(2, 3\)"),
            (torch.zeros(2), -1.0, "positive semi-definite"),
            (torch.zeros(2), torch.tensor([[0.0, 1.0], [1.0, 0.0]]), "positive semi-definite"),
            (torch.zeros(2), torch.tensor([[1.0, 9.0], [0.0, 1.0]]), "positive semi-definite"),
            (torch.zeros(2), torch.inf, "weight must be finite"),
        ],
    )
    def test_bad_input_is_refused(self, target: Tensor, weight: object, message: str) -> None:
        with pytest.raises(ValueError, match=message):
            quadratic_cost(target, weight)


def test_action_cost_ignores_the_latent() -> None:
    action = torch.tensor([[1.0, 2.0], [3.0, 0.0]])
    nan = torch.full((2, 3), torch.nan)
    torch.testing.assert_close(action_cost(0.1)(nan, action), torch.tensor([0.5, 0.9]))
    matrix = torch.tensor([[2.0, 1.0], [1.0, 2.0]])
    torch.testing.assert_close(action_cost(matrix)(nan, action), torch.tensor([14.0, 18.0]))
    with pytest.raises(ValueError, match=r"square matrix \(n, n\), got shape \(2, 3\)"):
        action_cost(torch.ones(2, 3))


class TestSums:
    def test_sum_scale_and_plain_functions(self) -> None:
        latent, action = torch.randn(7, 2), torch.randn(7, 2)
        first, second = quadratic_cost(torch.ones(2)), action_cost()
        expected = 3 * (first(latent, action) + 0.5 * second(latent, action))
        expected = expected + plain_cost(latent, action)
        for total in (
            3 * (first + 0.5 * second) + plain_cost,
            plain_cost + (first + second * 0.5) * 3,
            sum([3 * first, 1.5 * second, plain_cost + 0 * second]),
        ):
            assert isinstance(total, Cost)
            torch.testing.assert_close(total(latent, action), expected)

    def test_survives_pickle_and_copy_and_moves_dtype(self) -> None:
        total = quadratic_cost(torch.ones(2)) + 0.1 * action_cost() + plain_cost
        latent, action = torch.randn(3, 2), torch.randn(3, 2)
        for other in (pickle.loads(pickle.dumps(total)), copy.deepcopy(total)):
            assert torch.equal(other(latent, action), total(latent, action))
        assert total.double()(latent.double(), action.double()).dtype == torch.float64

    @pytest.mark.parametrize("other", ["text", 3.0, None])
    def test_what_is_no_cost_is_refused(self, other: object) -> None:
        with pytest.raises(TypeError):
            action_cost() + other
        with pytest.raises(TypeError):
            other + action_cost()

    def test_what_is_no_number_is_refused(self) -> None:
        with pytest.raises(TypeError):
            action_cost() * action_cost()


class TestQuadraticReward:
    def test_equals_the_quadratic_form(self) -> None:
        head = QuadraticReward(3, 2).double()
        for parameter in head.parameters():
            torch.nn.init.normal_(parameter)
        latent, action = torch.randn(4, 6, 3).double(), torch.randn(4, 6, 2).double()
        y = torch.cat([latent, action], -1)
        assert torch.equal(head.matrix, head.matrix.mT)
        assert head.triangle.numel() == 15
        expected = head.bias + torch.einsum("...i,ij,...j->...", y, head.matrix, y)[..., None]
        expected = expected + (y @ head.linear)[..., None]
        torch.testing.assert_close(head(latent, action), expected)

    def test_every_quadratic_reward_is_found_by_least_squares(self) -> None:
        # Convex in the parameters: Gauss-Newton from zero lands on the optimum in one step.
        latent, action = torch.randn(400, 3).double(), torch.randn(400, 2).double()
        goal = torch.randn(3).double()
        reward = -((latent - goal) ** 2).sum(-1) - 0.1 * (action**2).sum(-1)
        head = QuadraticReward(3, 2).double()
        parameters = dict(head.named_parameters())

        def predict(values: dict[str, Tensor]) -> Tensor:
            return torch.func.functional_call(head, values, (latent, action)).squeeze(-1)

        jacobian = torch.func.jacrev(predict)(parameters)
        design = torch.cat([jacobian[name].flatten(1) for name in parameters], dim=1)
        solution = torch.linalg.lstsq(design, reward[:, None]).solution.squeeze(-1)
        sizes = [p.numel() for p in parameters.values()]
        values = {
            name: part.reshape(parameters[name].shape)
            for name, part in zip(parameters, solution.split(sizes), strict=True)
        }
        torch.testing.assert_close(predict(values), reward)
        torch.testing.assert_close(values["linear"][:3], 2 * goal)

    def test_vmap_over_stacked_heads_equals_a_loop(self) -> None:
        heads = [QuadraticReward(2, 1) for _ in range(3)]
        for head in heads:
            for parameter in head.parameters():
                torch.nn.init.normal_(parameter)
        parameters, buffers = torch.func.stack_module_state(heads)
        latent, action = torch.randn(5, 2), torch.randn(5, 1)

        def call(params: dict[str, Tensor], buffers: dict[str, Tensor]) -> Tensor:
            return torch.func.functional_call(heads[0], (params, buffers), (latent, action))

        stacked = torch.vmap(call)(parameters, buffers)
        expected = torch.stack([head(latent, action) for head in heads])
        torch.testing.assert_close(stacked, expected)

    def test_starts_at_zero_and_resets(self) -> None:
        head = QuadraticReward(2, 1)
        latent, action = torch.randn(5, 2), torch.randn(5, 1)
        assert not head(latent, action).any()
        head(latent, action).sum().backward()
        assert all(p.grad.abs().sum() > 0 for p in head.parameters())
        torch.nn.init.ones_(head.linear)
        head.reset_parameters()
        assert not head(latent, action).any()

    def test_in_a_tensordict_module(self) -> None:
        module = TensorDictModule(QuadraticReward(4, 2), ["latent", "action"], ["reward"])
        td = TensorDict(latent=torch.zeros(3, 7, 4), action=torch.zeros(3, 7, 2), batch_size=[3, 7])
        assert module(td)["reward"].shape == (3, 7, 1)

    def test_without_action(self) -> None:
        assert QuadraticReward(4, 0)(torch.zeros(3, 4)).shape == (3, 1)
        with pytest.raises(ValueError, match=r"\(\*B, 4\) and \(\*B, 0\)"):
            QuadraticReward(4, 0)(torch.zeros(3, 4), torch.zeros(3, 1))

    def test_bad_input_is_refused(self) -> None:
        with pytest.raises(ValueError, match="latent_dim must be positive"):
            QuadraticReward(0, 1)
        with pytest.raises(ValueError, match=r"got \(3, 5\) and \(3, 2\)"):
            QuadraticReward(4, 2)(torch.zeros(3, 5), torch.zeros(3, 2))
        with pytest.raises(ValueError, match=r"got \(3, 4\) and None"):
            QuadraticReward(4, 2)(torch.zeros(3, 4))
