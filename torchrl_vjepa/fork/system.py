"""The equations of the fork, and what is known exactly about its future."""

from __future__ import annotations

import math
from statistics import NormalDist

import torch
from torch import Tensor
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal

from torchrl_vjepa.simulation import Simulation, State, check_nonnegative

__all__ = ["ForkSystem"]


class ForkSystem(Simulation):
    r"""A vehicle that swerves round a wall, to the left or to the right, by chance.

    The paper's robot that encounters an obstacle and chooses left or right (section "Limitations and
    Future Directions"), as a system whose predictive density is known. The state is the position
    :math:`x = (\text{along}, \text{across})` on a road; left is positive. The vehicle moves 1.5
    units along the road per step, and the action :math:`u` moves it across:

    .. math::
        x_{t+1} = x_t + \begin{pmatrix} 1.5 \\ u_t \end{pmatrix}
            + \mathbb 1[x_t \in \text{fork}]\, k_t\, b\, n(x_t) + \sigma \epsilon_t,
        \qquad k_t \in \{+1, -1\}, \quad \epsilon_t \sim N(0, I)

    The **wall** is the box :math:`|\text{along}| \le 1.25`, :math:`|\text{across}| \le w`. The **fork**
    lies before it, :math:`-2.75 \le \text{along} < -1.25`, and is one step long. There a reflex that the
    agent does not command swerves by :math:`b` at a right angle to the line of sight to the wall's
    centre, :math:`n(x) = (x_2, -x_1) / |x|`, to the left with probability ``left_probability``, else to
    the right. It does not know how wide the wall is, so *what is safe is to aim at the middle of the
    wall*: off the middle, the swerve to one side falls short. The mean of the two futures says the
    opposite: it lies in the wall for a safe aim, and beside it for one that crashes half of the time.

    Since :math:`n` turns with the position, no linear map makes the two coordinates of the future
    uncorrelated everywhere.

    :meth:`dist` is a transition: it goes where a model goes, for instance into
    :class:`~torchrl_vjepa.envs.LatentEnv` with :meth:`cost`, to plan on the truth.

    **Noise.** A start or a step uses three standard normal numbers
    :math:`(\kappa, \epsilon_1, \epsilon_2)`. The first is the coin: left if
    :math:`\Phi(\kappa) <` ``left_probability``. An episode starts at
    :math:`(-5, \texttt{start\_std}\, \epsilon_2)`.

    Args:
        left_probability: of the swerve to the left, inside (0, 1).
        swerve: :math:`b`, positive.
        wall_half_width: :math:`w`, positive.
        noise_std: :math:`\sigma`, positive.
        start_std: spread of the start across the road, at least 0.
        crash_cost: what being in the wall costs, at least 0.
        action_cost: weight of :math:`u^2` in the cost, at least 0.
        action_bound: largest :math:`|u|`, positive.
        episode_length: steps until truncation; 6 pass the wall.

    Raises:
        ValueError: for an argument out of range.
        TypeError: for an ``episode_length`` that is not an integer.

    Examples:
        >>> import torch
        >>> system = ForkSystem()
        >>> before_the_wall, straight_on = torch.tensor([-2.0, 0.0]), torch.tensor([0.0])
        >>> p = system.dist(before_the_wall, straight_on)
        >>> p.mean, system.in_wall(p.mean)
        (tensor([-0.5000,  0.0000]), tensor(True))
        >>> system.wall_mass(before_the_wall, straight_on) < 1e-6
        tensor(True)
        >>> system.wall_mass(before_the_wall, torch.tensor([0.8]))  # the mean is beside the wall
        tensor(0.5000)
    """

    speed: float = 1.5
    start_along: float = -5.0
    fork_range: tuple[float, float] = (-2.75, -1.25)
    wall_half_length: float = 1.25

    def __init__(
        self,
        *,
        left_probability: float = 0.5,
        swerve: float = 1.2,
        wall_half_width: float = 0.7,
        noise_std: float = 0.08,
        start_std: float = 0.6,
        crash_cost: float = 100.0,
        action_cost: float = 0.1,
        action_bound: float = 0.6,
        episode_length: int = 6,
    ) -> None:
        super().__init__(2, 1, 3, {"side": 1}, action_bound=action_bound, episode_length=episode_length)
        self.left_probability = float(left_probability)
        if not 0.0 < self.left_probability < 1.0:
            raise ValueError(f"left_probability must be inside (0, 1), got {left_probability}.")
        self.swerve = _check_positive("swerve", swerve)
        self.wall_half_width = _check_positive("wall_half_width", wall_half_width)
        self.noise_std = _check_positive("noise_std", noise_std)
        self.start_std = check_nonnegative("start_std", start_std)
        self.crash_cost = check_nonnegative("crash_cost", crash_cost)
        self.action_cost = check_nonnegative("action_cost", action_cost)

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}(left_probability={self.left_probability}, swerve={self.swerve}, "
            f"wall_half_width={self.wall_half_width}, noise_std={self.noise_std})"
        )

    def start(self, noise: Tensor) -> State:
        r"""The start of an episode.

        Args:
            noise: :math:`(\kappa, \epsilon_1, \epsilon_2)`, shape ``(*B, 3)``.

        Returns:
            ``observation``, the position of shape ``(*B, 2)``, and ``side``, zeros of shape ``(*B, 1)``.
        """
        across = self.start_std * noise[..., 2]
        position = torch.stack([torch.full_like(across, self.start_along), across], dim=-1)
        return {"observation": position, "side": torch.zeros_like(position[..., :1])}

    def step(self, state: State, action: Tensor, noise: Tensor) -> tuple[State, Tensor, Tensor]:
        r"""One step.

        Args:
            state: ``observation``, the position of shape ``(*B, 2)``; ``side`` is not read.
            action: :math:`u`, shape ``(*B, 1)``.
            noise: :math:`(\kappa, \epsilon_1, \epsilon_2)`, shape ``(*B, 3)``.

        Returns:
            The next position and the ``side`` of the swerve (1 left, -1 right, 0 outside of the fork);
            the reward, minus :meth:`cost`, shape ``(*B)``; whether the vehicle is in the wall, ``(*B)``.
        """
        position = state["observation"]
        threshold = NormalDist().inv_cdf(self.left_probability)
        side = torch.where(noise[..., :1] < threshold, 1.0, -1.0)
        side = torch.where(self.in_fork(position).unsqueeze(-1), side, 0.0).to(position.dtype)
        after = self._centre(position, action) + side * self._swerve(position)
        after = after + self.noise_std * noise[..., 1:]
        return {"observation": after, "side": side}, -self.cost(after, action), self.in_wall(after)

    def dist(self, position: Tensor, action: Tensor) -> MixtureSameFamily:
        r"""The true predictive density :math:`p(x_{t+1} \mid x_t, u_t)`.

        .. math::
            \sum_{k \in \{+1, -1\}} P(k)\,
            N\big(x_t + (1.5, u_t) + k\, b\, n(x_t)\, \mathbb 1[x_t \in \text{fork}],\ \sigma^2 I\big)

        Args:
            position: :math:`x_t`, shape ``(*B, 2)``.
            action: :math:`u_t`, shape ``(*B, 1)``; not clipped.

        Returns:
            A mixture of two Gaussians (left, right) with batch ``*B`` and event ``(2,)``.

        Raises:
            ValueError: for a wrong shape.

        Examples:
            >>> import torch
            >>> ForkSystem().dist(torch.tensor([-2.0, 0.0]), torch.zeros(1)).component_distribution.mean
            tensor([[-0.5000,  1.2000],
                    [-0.5000, -1.2000]])
        """
        if position.shape[-1:] != (2,) or action.shape != (*position.shape[:-1], 1):
            raise ValueError(
                "position and action must have shapes (*B, 2) and (*B, 1), got "
                f"{tuple(position.shape)} and {tuple(action.shape)}"
            )
        centre = self._centre(position, action)
        swerve = self._swerve(position) * self.in_fork(position).unsqueeze(-1)
        loc = torch.stack([centre + swerve, centre - swerve], dim=-2)
        scale = torch.full_like(loc, self.noise_std)
        probs = loc.new_tensor([self.left_probability, 1 - self.left_probability])
        return MixtureSameFamily(
            Categorical(probs=probs.expand(loc.shape[:-1]), validate_args=False),
            Independent(Normal(loc, scale, validate_args=False), 1, validate_args=False),
            validate_args=False,
        )

    def wall_mass(self, position: Tensor, action: Tensor) -> Tensor:
        r"""The true probability that the next position is in the wall, in closed form.

        Args:
            position: :math:`x_t`, shape ``(*B, 2)``.
            action: :math:`u_t`, shape ``(*B, 1)``; not clipped.

        Returns:
            Probabilities, shape ``(*B)``.

        Raises:
            ValueError: for a wrong shape.

        Examples:
            >>> import torch
            >>> ForkSystem(left_probability=0.25).wall_mass(torch.tensor([-2.0, 0.7]), torch.zeros(1))
            tensor(0.7497)
        """
        p = self.dist(position, action)
        loc = p.component_distribution.mean
        half = loc.new_tensor([self.wall_half_length, self.wall_half_width])
        # By symmetry of the box: the difference of the two tails nearest to zero is the accurate one.
        distance = loc.abs()
        below = torch.special.ndtr((half - distance) / self.noise_std)
        beyond = torch.special.ndtr((-half - distance) / self.noise_std)
        return (p.mixture_distribution.probs * (below - beyond).prod(-1)).sum(-1)

    def in_wall(self, position: Tensor) -> Tensor:
        """Whether a position is in the wall.

        Args:
            position: shape ``(*B, 2)``.

        Returns:
            Booleans, shape ``(*B)``.

        Examples:
            >>> import torch
            >>> ForkSystem().in_wall(torch.tensor([[0.0, 0.0], [0.0, 1.0], [-2.0, 0.0]]))
            tensor([ True, False, False])
        """
        along, across = position.unbind(-1)
        return (along.abs() <= self.wall_half_length) & (across.abs() <= self.wall_half_width)

    def in_fork(self, position: Tensor) -> Tensor:
        """Whether the next step swerves.

        Args:
            position: shape ``(*B, 2)``.

        Returns:
            Booleans, shape ``(*B)``.

        Examples:
            >>> import torch
            >>> ForkSystem().in_fork(torch.tensor([[-3.5, 0.0], [-2.0, 0.0], [-0.5, 0.0]]))
            tensor([False,  True, False])
        """
        low, high = self.fork_range
        return (position[..., 0] >= low) & (position[..., 0] < high)

    def cost(self, next_position: Tensor, action: Tensor) -> Tensor:
        r"""Cost of a step: squared distance to the middle of the road, effort, and the wall.

        :math:`\text{across}'^2 + \texttt{action\_cost}\, u^2 + \texttt{crash\_cost}\,
        \mathbb 1[x' \in \text{wall}]`. The argument ``cost`` of a planning environment.

        Args:
            next_position: :math:`x_{t+1}`, shape ``(*B, 2)``.
            action: :math:`u_t`, shape ``(*B, 1)``.

        Returns:
            Costs, shape ``(*B)``.

        Examples:
            >>> import torch
            >>> ForkSystem().cost(torch.tensor([[0.0, 0.5], [0.0, 1.0]]), torch.zeros(2, 1))
            tensor([100.2500,   1.0000])
        """
        effort = self.action_cost * action.square().sum(-1)
        crash = self.crash_cost * self.in_wall(next_position).to(next_position.dtype)
        return next_position[..., 1].square() + effort + crash

    def _centre(self, position: Tensor, action: Tensor) -> Tensor:
        """Where the step leads without swerve and noise."""
        return position + torch.cat([torch.full_like(action, self.speed), action], dim=-1)

    def _swerve(self, position: Tensor) -> Tensor:
        """The swerve to the left, ``b n(x)``; it counts in the fork alone, away from the origin."""
        along, across = position.unbind(-1)
        distance = position.square().sum(-1).clamp_min(1e-12).sqrt()  # hypot has no gradient at 0
        return self.swerve * torch.stack([across / distance, -along / distance], dim=-1)


def _check_positive(name: str, value: float) -> float:
    number = float(value)
    if not 0.0 < number < math.inf:
        raise ValueError(f"{name} must be positive and finite, got {value}.")
    return number
