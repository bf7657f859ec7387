"""The exact answers on the noisy TV: Kalman filter, linear-quadratic regulator, LQG control."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Unbounded
from torchrl.envs import TensorDictPrimer

from torchrl_vjepa.noisy_tv.system import LinearGaussianSystem
from torchrl_vjepa.simulation import check_nonnegative, check_positive_int

__all__ = ["KalmanFilter", "LQGController", "LQRSolution", "solve_lqr"]

_MAX_SCHEDULE = 20_000


class LQRSolution(NamedTuple):
    r"""The optimal fully observed controller ``u = k - K s`` and its cost.

    Attributes:
        gain: ``K``, shape ``(control_dim, signal_dim)``.
        feedforward: ``k``, shape ``(control_dim,)``.
        value_matrix: ``P`` of the relative value ``s^T P s - 2 p^T s``.
        value_vector: ``p``, shape ``(signal_dim,)``.
        cost: average cost per step, ``E |s' - g|^2 + action_cost |u|^2``.

    Examples:
        >>> solve_lqr(LinearGaussianSystem(control_dim=2)).value_vector.shape
        torch.Size([4])
    """

    gain: Tensor
    feedforward: Tensor
    value_matrix: Tensor
    value_vector: Tensor
    cost: float


def solve_lqr(system: LinearGaussianSystem, action_cost: float = 0.1) -> LQRSolution:
    r"""Linear-quadratic regulator to the goal at the lowest average cost per step.

    Stage cost ``|s_{t+1} - g|^2 + lambda |u_t|^2``. Its long-run average equals that of
    ``|s_t - g|^2 + lambda |u_t|^2``, so with the relative value ``V(s) = s^T P s - 2 p^T s``

    .. math::
        P &= I + A^T P A - A^T P B M^{-1} B^T P A, \qquad M = \lambda I + B^T P B \\
        u &= k - K s, \qquad K = M^{-1} B^T P A, \quad k = M^{-1} B^T p \\
        p &= g + (A - B K)^T p \\
        J &= |g|^2 - p^T B M^{-1} B^T p + \mathrm{tr}(P\,\mathrm{Cov}[w]).

    Args:
        system: a system with control.
        action_cost: ``lambda``, positive.

    Returns:
        Gains, value function and average cost, in float64.

    Raises:
        ValueError: for a system without control, one that no control can stabilise, or
            ``action_cost <= 0``.
        ImportError: without SciPy.

    Examples:
        >>> solution = solve_lqr(LinearGaussianSystem(control_dim=2, seed=0))
        >>> solution.gain.shape, round(solution.cost, 2)
        (torch.Size([2, 4]), 1.07)
    """
    try:
        from scipy.linalg import LinAlgError, solve_discrete_are
    except ImportError as err:
        raise ImportError("solve_lqr needs SciPy: pip install 'torchrl-vjepa[examples]'") from err
    check_positive_int("system.control_dim", system.control_dim)
    if check_nonnegative("action_cost", action_cost) == 0:
        raise ValueError("action_cost must be positive for the regulator, got 0.")
    A, B, g = system.A, system.B, system.goal
    Q = torch.eye(system.signal_dim, dtype=torch.float64)
    R = action_cost * torch.eye(system.control_dim, dtype=torch.float64)
    try:
        P = torch.from_numpy(solve_discrete_are(*(m.numpy() for m in (A, B, Q, R))))
    except LinAlgError as error:
        raise ValueError(
            "system must be stabilisable by its control, but its Riccati equation has no "
            f"stabilising solution ({error}). Use another B or a stable A."
        ) from error
    M = R + B.mT @ P @ B
    K = torch.linalg.solve(M, B.mT @ P @ A)
    p = torch.linalg.solve(Q - (A - B @ K).mT, g)
    k = torch.linalg.solve(M, B.mT @ p)
    cost = g @ g - p @ B @ k + system.signal_std**2 * P.trace()
    return LQRSolution(K, k, P, p, cost.item())


class KalmanFilter(nn.Module):
    r"""Exact filter for the joint state ``z = [s; d]`` of the noisy TV at one noise scale.

    .. math::
        z_{t+1} = F z_t + G u_t + n_t, \qquad x_t = H z_t + \epsilon_t, \qquad z_0 \sim N(0, I),

    ``F = diag(A, rho I)``, ``G = [B; 0]``, ``H = [C, sigma D]``. Covariances do not depend on the
    data: they are computed once, in float64, step by step until they have converged to ``1e-12``,
    and the last one stands for all later steps. The filter is thus time-varying and exact.

    :meth:`filter` runs over trajectories; :meth:`update` and :meth:`predict` are its half-steps.

    Args:
        system: the system; its ``sensor_std`` must be positive.
        noise_scale: the distractor's scale ``sigma`` in the observations, at least 0.

    Raises:
        ValueError: for ``sensor_std = 0``, a negative ``noise_scale``, or a system whose
            covariance does not converge (a state that neither decays nor is seen).

    Examples:
        >>> system = LinearGaussianSystem()
        >>> data = system.simulate(100, noise_scale=8.0)
        >>> belief = KalmanFilter(system, noise_scale=8.0).filter(data["observation"])
        >>> bool((belief["signal_mean"] - data["signal"]).square().mean() < 1e-3)
        True
    """

    F: Tensor
    G: Tensor
    H: Tensor
    process_covariance: Tensor
    predicted_covariance: Tensor
    filtered_covariance: Tensor
    gain: Tensor
    innovation_cholesky: Tensor

    def __init__(self, system: LinearGaussianSystem, noise_scale: float) -> None:
        super().__init__()
        self.system, self.noise_scale = system, check_nonnegative("noise_scale", noise_scale)
        if system.sensor_std == 0:
            raise ValueError(
                "system.sensor_std must be positive for the filter, got 0: the covariance of the "
                "observation would be singular. Use a small value such as 1e-6."
            )
        S, Dd = system.signal_dim, system.distractor_dim
        rho = system.distractor_decay * torch.eye(Dd, dtype=torch.float64)
        self.register_buffer("F", torch.block_diag(system.A, rho))
        self.register_buffer("G", torch.cat([system.B, system.B.new_zeros(Dd, system.control_dim)]))
        self.register_buffer("H", torch.cat([system.C, self.noise_scale * system.D], dim=1))
        stds = rho.new_tensor([system.signal_std] * S + [system.distractor_std] * Dd)
        self.register_buffer("process_covariance", torch.diag(stds.square()))
        self._register_schedule()

    def _register_schedule(self) -> None:
        F, H, Q = self.F, self.H, self.process_covariance
        I_z = torch.eye(F.shape[0], dtype=torch.float64)
        R = self.system.sensor_std**2 * torch.eye(H.shape[0], dtype=torch.float64)
        schedule: list[tuple[Tensor, ...]] = []
        predicted, filtered_before = I_z, torch.full_like(I_z, math.inf)
        while len(schedule) < _MAX_SCHEDULE:
            L = torch.linalg.cholesky(H @ predicted @ H.mT + R)
            K = torch.cholesky_solve(H @ predicted, L).mT
            # Joseph's form: stays symmetric and positive under rounding.
            J = I_z - K @ H
            filtered = J @ predicted @ J.mT + K @ R @ K.mT
            schedule.append((predicted, filtered, K, L))
            if (filtered - filtered_before).abs().max() <= 1e-12 * filtered.abs().max():
                break
            filtered_before, predicted = filtered, F @ filtered @ F.mT + Q
        else:
            raise ValueError(
                f"the filter's covariance must converge, but did not in {_MAX_SCHEDULE} steps: a "
                "part of the state neither decays nor shows in the observation (distractor_decay="
                f"{self.system.distractor_decay}, noise_scale={self.noise_scale})."
            )
        names = ("predicted_covariance", "filtered_covariance", "gain", "innovation_cholesky")
        for name, values in zip(names, zip(*schedule, strict=True), strict=True):
            self.register_buffer(name, torch.stack(values))

    def update(self, predicted_mean: Tensor, observation: Tensor, time: Tensor) -> Tensor:
        """Mean of the state after an observation: ``m + K_t (x_t - H m)``.

        Args:
            predicted_mean: ``E[z_t | x_{<t}]``, shape ``(*B, signal_dim + distractor_dim)``.
            observation: ``x_t``, shape ``(*B, observation_dim)``.
            time: ``t``, the number of earlier observations, int64 of shape ``(*B)``.

        Returns:
            ``E[z_t | x_{<=t}]``, shape ``(*B, signal_dim + distractor_dim)``.

        Examples:
            >>> filter = KalmanFilter(LinearGaussianSystem(), 0.0)
            >>> filter.update(torch.zeros(8).double(), torch.zeros(20), torch.tensor(0)).norm()
            tensor(0., dtype=torch.float64)
        """
        gain = self.gain[time.clamp_max(len(self.gain) - 1)]
        innovation = observation.to(predicted_mean) - predicted_mean @ self.H.mT
        return predicted_mean + (gain @ innovation.unsqueeze(-1)).squeeze(-1)

    def predict(self, filtered_mean: Tensor, action: Tensor | None = None) -> Tensor:
        """Mean of the next state: ``F m + G u``.

        Args:
            filtered_mean: ``E[z_t | x_{<=t}]``, shape ``(*B, signal_dim + distractor_dim)``.
            action: ``u_t``, shape ``(*B, control_dim)``; None is zero.

        Returns:
            ``E[z_{t+1} | x_{<=t}]``, shape ``(*B, signal_dim + distractor_dim)``.

        Examples:
            >>> filter = KalmanFilter(LinearGaussianSystem(), 0.0)
            >>> filter.predict(torch.ones(8).double())[4:]
            tensor([0.9000, 0.9000, 0.9000, 0.9000], dtype=torch.float64)
        """
        mean = filtered_mean @ self.F.mT
        return mean if action is None else mean + action.to(mean) @ self.G.mT

    def filter(self, observations: Tensor, actions: Tensor | None = None) -> TensorDict:
        """Beliefs about the signal at every step of trajectories.

        Args:
            observations: ``x``, shape ``(*B, T, observation_dim)``.
            actions: ``u``, shape ``(*B, T, control_dim)``, ``u_t`` moving step ``t`` to ``t + 1``;
                None is zero.

        Returns:
            A TensorDict of batch size ``(*B, T)``, in float64, with

            - ``signal_mean``, ``signal_cov``: of ``s_t`` given ``x_{<=t}``;
            - ``distractor_mean``: of ``d_t`` given ``x_{<=t}``;
            - ``next_signal_mean``, ``next_signal_cov``: of ``s_{t+1}`` given ``x_{<=t}, u_{<=t}``;
            - ``log_evidence``: ``log p(x_t | x_{<t}, u_{<t})``; sum it over time for the total.

        Raises:
            ValueError: for a wrong shape, or NaN or infinite entries.

        Examples:
            >>> filter = KalmanFilter(LinearGaussianSystem(control_dim=2), 1.0)
            >>> belief = filter.filter(torch.zeros(5, 10, 20), torch.zeros(5, 10, 2))
            >>> belief["next_signal_mean"].shape, belief["log_evidence"].shape
            (torch.Size([5, 10, 4]), torch.Size([5, 10]))
        """
        S, X = self.system.signal_dim, self.system.observation_dim
        x = observations.to(self.H)
        u = x.new_zeros(*x.shape[:-1], self.G.shape[1]) if actions is None else actions.to(x)
        batch_size = x.shape[:-1]
        if x.ndim < 2 or batch_size[-1] < 1:
            raise ValueError(f"observations must have shape (*B, T, {X}), got {tuple(x.shape)}.")
        for name, value, size in (("observations", x, X), ("actions", u, self.G.shape[1])):
            if value.shape != (*batch_size, size):
                expected = (*batch_size, size)
                raise ValueError(f"{name} must have shape {expected}, got {tuple(value.shape)}.")
            if not value.isfinite().all():
                raise ValueError(f"{name} must be finite, got NaN or infinite entries.")
        index = torch.arange(batch_size[-1], device=x.device).clamp_max(len(self.gain) - 1)
        predictions, means = [x.new_zeros(*batch_size[:-1], self.F.shape[0])], []
        for t in range(batch_size[-1]):
            means.append(self.update(predictions[t], x[..., t, :], index[t]))
            predictions.append(self.predict(means[t], u[..., t, :]))
        mean, prediction = torch.stack(means, dim=-2), torch.stack(predictions[:-1], dim=-2)
        # log N(x; H m, L L^T)
        L, innovation = self.innovation_cholesky[index], (x - prediction @ self.H.mT).unsqueeze(-1)
        whitened = torch.linalg.solve_triangular(L, innovation, upper=False).squeeze(-1)
        log_det = 2 * L.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        log_evidence = -0.5 * (whitened.square().sum(-1) + log_det + X * math.log(2 * math.pi))
        signal_cov, A = self.filtered_covariance[index, :S, :S], self.F[:S, :S]
        next_signal_cov = A @ signal_cov @ A.mT + self.process_covariance[:S, :S]
        return TensorDict(
            {
                "signal_mean": mean[..., :S],
                "signal_cov": signal_cov.expand(*batch_size, S, S),
                "distractor_mean": mean[..., S:],
                "next_signal_mean": self.predict(mean, u)[..., :S],
                "next_signal_cov": next_signal_cov.expand(*batch_size, S, S),
                "log_evidence": log_evidence,
            },
            batch_size=batch_size,
        )


class LQGController(TensorDictModuleBase):
    r"""The optimal controller from observations: ``u_t = k - K E[s_t | x_{<=t}]``, clipped.

    The gains are those of :func:`solve_lqr` (infinite horizon), the estimate is that of
    :class:`KalmanFilter` (exact and time-varying, by the step index carried in the tensordict).
    The clipped action is what the filter predicts with.

    As a policy it keeps its memory in the tensordict: it reads ``belief_key`` (mean of the state
    before this observation, float64) and ``time_key`` (observations so far), starts rows anew
    where ``is_init_key`` is True, and writes both under ``"next"``. The environment needs the
    transforms of ``torchrl.modules.get_env_transforms_from_module(controller)``.

    Args:
        system: a system with control.
        noise_scale: the distractor's scale ``sigma`` in the observations, at least 0.
        action_cost: weight of ``|u|^2``, positive.
        action_bound: actions are clipped to ``[-action_bound, action_bound]``; may be infinite.
        observation_key: where the observation is read.
        action_key: where the action is written.
        belief_key: name of the memory's mean.
        time_key: name of the memory's step counter.
        is_init_key: where the first step of an episode is marked.

    Raises:
        ValueError: for an argument out of range or a system that cannot be stabilised.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl.modules import get_env_transforms_from_module
        >>> from torchrl_vjepa.noisy_tv import BatchedNoisyTVEnv
        >>> env = BatchedNoisyTVEnv(16, noise_scale=8.0, seed=0)
        >>> controller = LQGController(env.system, noise_scale=8.0)
        >>> env = TransformedEnv(env, get_env_transforms_from_module(controller))
        >>> rollout = env.rollout(200, controller)
        >>> bool(1.0 < -rollout["next", "reward"].mean() < 1.2)
        True
    """

    gain: Tensor
    feedforward: Tensor

    def __init__(
        self,
        system: LinearGaussianSystem,
        noise_scale: float,
        action_cost: float = 0.1,
        *,
        action_bound: float = 2.0,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        belief_key: NestedKey = "lqg_belief",
        time_key: NestedKey = "lqg_time",
        is_init_key: NestedKey = "is_init",
    ) -> None:
        super().__init__()
        if not action_bound > 0:
            raise ValueError(f"action_bound must be positive, got {action_bound}.")
        self.system, self.action_cost, self.action_bound = system, action_cost, action_bound
        self.solution = solve_lqr(system, action_cost)
        self.kalman = KalmanFilter(system, noise_scale)
        self.register_buffer("gain", self.solution.gain)
        self.register_buffer("feedforward", self.solution.feedforward)
        self.in_keys = [observation_key, belief_key, time_key, is_init_key]
        next_keys = [unravel_key(("next", key)) for key in (belief_key, time_key)]
        self.out_keys = [action_key, *next_keys]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action and the memory of the next step.

        Args:
            tensordict: of batch size ``(*B)`` with ``observation (*B, observation_dim)``, the
                memory and ``is_init (*B, 1)``.

        Returns:
            The same tensordict with ``action (*B, control_dim)`` and ``("next", ...)`` memory.

        Raises:
            KeyError: without the memory or ``is_init``.
            ValueError: if the observation has a wrong size, or is NaN or infinite.
        """
        missing = [key for key in self.in_keys if tensordict.get(key, None) is None]
        if missing:
            raise KeyError(
                f"LQGController needs the entries {missing}: append "
                "torchrl.modules.get_env_transforms_from_module(controller) to the environment."
            )
        observation, belief, time, is_init = (tensordict.get(key) for key in self.in_keys)
        size = self.system.observation_dim
        if observation.shape[-1] != size or not observation.isfinite().all():
            raise ValueError(
                f"{self.in_keys[0]} must be finite with last size {size}, got shape "
                f"{tuple(observation.shape)} and finite={bool(observation.isfinite().all())}."
            )
        belief = torch.where(is_init, 0.0, belief.to(self.gain))
        time = torch.where(is_init, 0, time)
        mean = self.kalman.update(belief, observation, time.squeeze(-1))
        action = self.feedforward - mean[..., : self.system.signal_dim] @ self.gain.mT
        action = action.clamp(-self.action_bound, self.action_bound).to(observation.dtype)
        results = (action, self.kalman.predict(mean, action), time + 1)
        for key, value in zip(self.out_keys, results, strict=True):
            tensordict.set(key, value)
        return tensordict

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The transform that adds the memory to an environment's specs and resets.

        Returns:
            A ``TensorDictPrimer`` with zeros for the belief and the step counter.

        Examples:
            >>> controller = LQGController(LinearGaussianSystem(control_dim=2), 1.0)
            >>> sorted(controller.make_tensordict_primer().primers.keys())
            ['lqg_belief', 'lqg_time']
        """
        _, belief_key, time_key, _ = self.in_keys
        belief = Unbounded((len(self.kalman.F),), dtype=torch.float64)
        primers = {belief_key: belief, time_key: Unbounded((1,), dtype=torch.int64)}
        return TensorDictPrimer(primers, default_value=0.0, expand_specs=True)

    def expected_cost(self, num_steps: int | None = None) -> float:
        r"""Expected cost per step ``|s' - g|^2 + action_cost |u|^2``, without clipping.

        With ``m_t, V_t`` mean and covariance of the estimate, ``Sigma_t`` the filter's covariance,
        and ``E_t`` that of the estimate's innovation (predicted minus filtered covariance),

        .. math::
            m_{t+1} &= (A - BK) m_t + B k, \qquad
            V_{t+1} = (A - BK) V_t (A - BK)^T + E_{t+1} \\
            c_t &= |m_{t+1} - g|^2 + \mathrm{tr}(V_{t+1} + \Sigma_{t+1})
                + \lambda (|k - K m_t|^2 + \mathrm{tr}(K V_t K^T)),

        averaged over ``t``. The limit is ``J + tr(K^T M K Sigma)``: the cost ``J`` of the fully
        observed problem (``solution.cost``) and the price of the estimation error.

        Args:
            num_steps: episode length, from ``s_0`` standard normal; None is the limit.

        Returns:
            The average cost per step.

        Raises:
            ValueError: for ``num_steps < 1``.

        Examples:
            >>> controller = LQGController(LinearGaussianSystem(control_dim=2), 8.0)
            >>> controller.expected_cost() > controller.solution.cost
            True
        """
        S, lam = self.system.signal_dim, self.action_cost
        A, B, g = (m.to(self.gain) for m in (self.system.A, self.system.B, self.system.goal))
        K, k = self.gain, self.feedforward
        predicted = self.kalman.predicted_covariance[:, :S, :S]
        filtered = self.kalman.filtered_covariance[:, :S, :S]
        if num_steps is None:
            P = self.solution.value_matrix.to(K)
            M = lam * torch.eye(len(k)).to(K) + B.mT @ P @ B
            return self.solution.cost + (K.mT @ M @ K @ filtered[-1]).trace().item()
        closed, total = A - B @ K, 0.0
        mean, cov = torch.zeros_like(g), predicted[0] - filtered[0]
        for t in range(1, check_positive_int("num_steps", num_steps) + 1):
            control = (k - K @ mean).square().sum() + (K @ cov @ K.mT).trace()
            i = min(t, len(filtered) - 1)
            mean = closed @ mean + B @ k
            cov = closed @ cov @ closed.mT + predicted[i] - filtered[i]
            error = (mean - g).square().sum() + (cov + filtered[i]).trace()
            total += (error + lam * control).item()
        return total / num_steps
