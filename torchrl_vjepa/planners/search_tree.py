"""Monte Carlo search trees of many rows at once, as tensors."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

__all__ = ["SearchTree"]

#: Stands for no visit in a quotient: a power of two, so that what is multiplied by it comes back exactly.
NO_VISIT = 2.0**-60


class SearchTree:
    r"""``R`` trees of at most ``num_nodes`` nodes with ``n`` actions each, in tensors ``(R, num_nodes, n)``.

    What a row holds depends on that row alone; what is read or written is the same node number in all rows,
    or one node for each row by a gather. Node 0 is the root.

    **Scores.** Of an edge with visits :math:`N_a`, of which :math:`F_a` had a finite cost with mean
    :math:`\bar J_a`, the score reads the mean of values that are normalised among the actions of its node,

    .. math:: \tilde Q_a = \frac{F_a}{N_a} \,
        \frac{\max_b \bar J_b - \bar J_a}{\max_b \bar J_b - \min_b \bar J_b},

    so that exploration does not depend on the scale or the offset of the costs, and a cost that is not finite
    counts as the worst. Costs are those of whole simulations, from the root on: what was paid on the way to a
    node is the same for all its actions. An action without visits has the mean value of the others. With
    TorchRL's :class:`~torchrl.modules.mcts.PUCTScore` the score is

    .. math:: \tilde Q_a + c \, P_a \frac{\sqrt{1 + \sum_b N_b}}{1 + N_a},

    where the one is the visit that made the node: the first choice is that of the prior.

    **Speed.** The best action of a node depends on the statistics of that node only. So :meth:`backup` scores
    the nodes it has changed, in one call, and :meth:`descend` follows pointers.

    Args:
        prior: probabilities of the root's actions, of shape ``(R, n)``.
        num_nodes: nodes there is room for.
        max_depth: steps from the root behind which nothing is chosen any more.
        score: TensorDictModule that reads ``win_count``, ``visits``, ``total_visits`` and ``prior_prob`` and
            writes ``score``.

    Examples:
        >>> from torchrl.modules.mcts import PUCTScore
        >>> tree = SearchTree(torch.tensor([[0.4, 0.6]]), num_nodes=3, max_depth=2, score=PUCTScore(c=1.0))
        >>> path = tree.descend()
        >>> action = tree.choice.gather(1, path)
        >>> path, action
        (tensor([[0]]), tensor([[1]]))
        >>> tree.add(1, path[:, -1], action[:, -1], torch.tensor([[0.5, 0.5]]), torch.tensor([True]))
        >>> tree.backup(path, action, torch.tensor([3.0]))
        >>> tree.visits[:, 0], tree.choice[:, 0]
        (tensor([[0., 1.]]), tensor([0]))
    """

    def __init__(self, prior: Tensor, num_nodes: int, max_depth: int, score: TensorDictModuleBase) -> None:
        rows, num_actions = prior.shape
        shape = (rows, num_nodes, num_actions)
        self.max_depth, self.score = max_depth, score
        self.prior, self.visits, self.finite, self.mean = (prior.new_zeros(shape) for _ in range(4))
        self.children = torch.full(shape, -1, dtype=torch.long, device=prior.device)
        self.depth = self.children.new_zeros(rows, num_nodes)
        self.choice = torch.zeros_like(self.depth)
        # Where a descent goes on from each node: to itself where it ends.
        self.following = torch.arange(num_nodes, device=prior.device).repeat(rows, 1)
        self.prior[:, 0] = prior
        self.choice[:, 0] = prior.argmax(dim=-1)

    def descend(self) -> Tensor:
        """Follow the best scores from the root to an edge without a child, or to the last depth.

        Returns:
            Nodes of shape ``(R, L)``; a row whose path is shorter repeats its last node. The action that is
            tried there is ``choice`` of the last node. Reads one flag per level from the device.
        """
        node = torch.zeros_like(self.depth[:, :1])
        path = [node]
        for _ in range(self.max_depth):
            following = self.following.gather(1, node)
            if torch.equal(following, node):
                break
            node = following
            path.append(node)
        return torch.cat(path, dim=1)

    def add(self, node: int, parent: Tensor, action: Tensor, prior: Tensor, linked: Tensor) -> None:
        """Put a node below another.

        Args:
            node: its number, the same in all rows.
            parent: the node above, of shape ``(R)``.
            action: that leads to it, of shape ``(R)``.
            prior: probabilities of its own actions, of shape ``(R, n)``.
            linked: flags ``(R)``; where ``False`` the node stays out of the tree.
        """
        parent, edge = parent.unsqueeze(1), self._edge(parent.unsqueeze(1), action.unsqueeze(1))
        children = self.children.flatten(1)
        child = torch.where(linked.unsqueeze(1), node, children.gather(1, edge))
        children.scatter_(1, edge, child)
        self.depth[:, node] = self.depth.gather(1, parent).squeeze(1) + 1
        self.prior[:, node] = prior
        self.choice[:, node] = prior.argmax(dim=-1)

    def backup(self, path: Tensor, actions: Tensor, cost: Tensor, simulated: Tensor | None = None) -> None:
        """Count a simulation in the edges of a path, and choose anew in its nodes.

        Args:
            path: nodes ``(R, L)`` as from :meth:`descend`; a node that is repeated counts once.
            actions: that were taken there, of shape ``(R, L)``; not counted at the last depth.
            cost: of the whole simulation, of shape ``(R)``; ``nan`` and infinities count as the worst.
            simulated: flags ``(R)`` of the rows that count; all by default.
        """
        counted = self.depth.gather(1, path) < self.max_depth
        counted[:, 1:] &= path[:, 1:] != path[:, :-1]
        if simulated is not None:
            counted &= simulated.unsqueeze(1)
        edge = self._edge(path, actions)
        visit = counted.to(cost.dtype)
        finite = visit * cost.isfinite().unsqueeze(1)
        self.visits.flatten(1).scatter_add_(1, edge, visit)
        finites, means = self.finite.flatten(1), self.mean.flatten(1)
        finites.scatter_add_(1, edge, finite)
        # Running means: sums would lose digits, and overflow.
        limit = 0.25 * torch.finfo(cost.dtype).max
        cost = cost.nan_to_num(0.0, 0.0, 0.0).clamp(-limit, limit).unsqueeze(1)
        step = finite * (cost - means.gather(1, edge)) / finites.gather(1, edge).clamp_min(1)
        means.scatter_add_(1, edge, step)
        self._choose(path)

    def values(self, nodes: Tensor) -> Tensor:
        r"""Values :math:`\tilde Q` of the actions of some nodes; without visits the mean of the others.

        Args:
            nodes: of shape ``(R, L)``.

        Returns:
            In ``[0, 1]``, of shape ``(R, L, n)``.
        """
        visits = self._of(self.visits, nodes)
        won = self._won(nodes)
        mean = won.sum(dim=-1, keepdim=True) / visits.sum(dim=-1, keepdim=True).clamp_min(1)
        return torch.where(visits > 0, won / visits.clamp_min(1), mean)

    def scores(self, nodes: Tensor) -> Tensor:
        """Scores of the actions of some nodes.

        Args:
            nodes: of shape ``(R, L)``.

        Returns:
            Of shape ``(R, L, n)``.
        """
        visits, prior = self._of(self.visits, nodes), self._of(self.prior, nodes)
        total = visits.sum(dim=-1, keepdim=True)
        won = self._won(nodes)
        unvisited = won.sum(dim=-1, keepdim=True) / total.clamp_min(1) * NO_VISIT
        statistics = {
            "win_count": torch.where(visits > 0, won, unvisited),
            "visits": visits.clamp_min(NO_VISIT),
            "total_visits": total + 1,
            "prior_prob": prior,
        }
        return self.score(TensorDict(statistics, batch_size=visits.shape[:-1])).get("score")

    def principal_variation(self) -> tuple[Tensor, Tensor]:
        """The most visited actions from the root on; of equal visits the action of the best value.

        Returns:
            Actions ``(R, max_depth)``, the last one repeated where the tree ends, and the shares of the
            visits of all actions of their nodes, ``(R, max_depth, n)``; all the last action's where it has
            ended.
        """
        node = torch.zeros_like(self.depth[:, :1])
        inside = torch.ones_like(node, dtype=torch.bool)
        action = node
        actions, shares = [], []
        for _ in range(self.max_depth):
            visits = self._of(self.visits, node).squeeze(1)
            total = visits.sum(dim=-1, keepdim=True)
            inside = inside & (total > 0)
            best = (visits + 0.5 * self.values(node).squeeze(1)).argmax(dim=-1, keepdim=True)
            action = torch.where(inside, best, action)
            certain = torch.zeros_like(visits).scatter_(1, action, 1.0)
            shares.append(torch.where(inside, visits / total.clamp_min(1), certain))
            actions.append(action)
            child = self._of(self.children, node).squeeze(1).gather(1, action)
            inside = inside & (child >= 0)
            node = torch.where(inside, child, node)
        return torch.cat(actions, dim=1), torch.stack(shares, dim=1)

    def _choose(self, nodes: Tensor) -> None:
        """The best action of some nodes, and where a descent goes on from them."""
        choice = self.scores(nodes).argmax(dim=-1)
        child = self._of(self.children, nodes).gather(-1, choice.unsqueeze(-1)).squeeze(-1)
        self.choice.scatter_(1, nodes, choice)
        self.following.scatter_(1, nodes, torch.where(child < 0, nodes, child))

    def _won(self, nodes: Tensor) -> Tensor:
        """Sums of normalised values, as a score reads them; zero without visits."""
        finite, mean = self._of(self.finite, nodes), self._of(self.mean, nodes)
        best = torch.where(finite > 0, mean, torch.inf).amin(dim=-1, keepdim=True)
        worst = torch.where(finite > 0, mean, -torch.inf).amax(dim=-1, keepdim=True)
        span = worst - best
        # Of one value, or several that are equal, nobody knows whether it is good.
        return finite * torch.where(span > 0, (worst - mean) / span, 0.5)

    def _edge(self, node: Tensor, action: Tensor) -> Tensor:
        return node * self.prior.shape[-1] + action

    @staticmethod
    def _of(statistic: Tensor, nodes: Tensor) -> Tensor:
        """``(R, L, n)`` of ``(R, num_nodes, n)``."""
        index = nodes.unsqueeze(-1).expand(*nodes.shape, statistic.shape[-1])
        return statistic.gather(1, index)
