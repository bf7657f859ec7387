"""The noisy-TV linear-Gaussian system: a small signal under a large, predictable distractor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_vjepa.simulation import check_nonnegative, check_positive_int

__all__ = ["LinearGaussianSystem", "linear_recurrence"]

MatrixLike = Tensor | np.ndarray | Sequence[Sequence[float]]
VectorLike = Tensor | np.ndarray | Sequence[float]


def linear_recurrence(matrix: Tensor, inputs: Tensor) -> Tensor:
    r"""Solves ``x_0 = c_0, x_t = M x_{t-1} + c_t`` for all times in ``log2(T)`` passes.

    A doubling scan: after pass ``k`` every state sums its last ``2^k`` inputs. It only ever
    multiplies by powers ``M^(2^k)`` and never inverts, so it stays accurate for stable matrices.

    Args:
        matrix: ``M``, shape ``(D, D)``.
        inputs: ``c``, shape ``(*B, T, D)``, same dtype as ``matrix``; float64 is advised.

    Returns:
        The states ``x``, shape ``(*B, T, D)``.

    Examples:
        >>> linear_recurrence(torch.tensor([[0.5]]), torch.ones(4, 1)).squeeze(-1)
        tensor([1.0000, 1.5000, 1.7500, 1.8750])
    """
    states = inputs.clone()
    power, shift = matrix, 1
    while shift < inputs.shape[-2]:
        states[..., shift:, :] += states[..., :-shift, :] @ power.mT
        power, shift = power @ power, 2 * shift
    return states


def _check_array(name: str, value: object, shape: tuple[int, ...]) -> Tensor:
    array = torch.as_tensor(value, dtype=torch.float64).detach().clone()
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {tuple(array.shape)}.")
    if not array.isfinite().all():
        raise ValueError(f"{name} must be finite, got NaN or infinite entries.")
    return array


class LinearGaussianSystem:
    r"""The paper's noisy TV (section "Toy Experiment"), with an optional control input.

    .. math::
        s_{t+1} &= A s_t + B u_t + w_t, & w_t &\sim N(0, \texttt{signal\_std}^2 I) \\
        d_{t+1} &= \rho d_t + v_t, & v_t &\sim N(0, \texttt{distractor\_std}^2 I) \\
        x_t &= C s_t + D (\sigma d_t) + \epsilon_t,
            & \epsilon_t &\sim N(0, \texttt{sensor\_std}^2 I)

    with ``s_0`` and ``d_0`` standard normal and ``sigma`` the ``noise_scale``. ``A`` is orthogonal,
    the columns of ``B``, ``C``, ``D`` and the ``goal`` have norm 1. They are drawn from
    ``numpy.random.RandomState(seed)`` in the order A, C, D, B, goal, so that ``seed=111`` gives
    the matrices of the paper's own program. A matrix passed by keyword replaces the drawn one and
    leaves the others as they are.

    **Time.** ``observation[t] = x_t``, ``signal[t] = s_t``, ``distractor[t] = d_t``, and
    ``action[t] = u_t`` moves ``s_t`` to ``s_{t+1}``; the last action of a trajectory acts after
    its end.

    **Noise.** All randomness of a trajectory is one array of standard normal numbers of shape
    ``(*B, T, noise_dim)``, ``noise_dim = signal_dim + distractor_dim + observation_dim``: row 0
    is ``[s_0, d_0, eps_0]`` and row ``t`` is ``[w_{t-1}, v_{t-1}, eps_t]``, each in units of its
    standard deviation. :meth:`start`, :meth:`step` and :meth:`unroll` are deterministic in it.

    Args:
        signal_dim: size of the signal ``s``.
        distractor_dim: size of the distractor ``d``.
        observation_dim: size of the observation ``x``.
        control_dim: size of the control ``u``; 0 for the paper's uncontrolled system.
        signal_std: standard deviation of ``w``.
        distractor_decay: ``rho``.
        distractor_std: standard deviation of ``v``.
        sensor_std: standard deviation of ``eps``.
        seed: draws the matrices, and starts the generator of :meth:`simulate`.
        A: signal transition, shape ``(signal_dim, signal_dim)``; need not be orthogonal.
        C: signal to observation, shape ``(observation_dim, signal_dim)``.
        D: distractor to observation, shape ``(observation_dim, distractor_dim)``.
        B: control to signal, shape ``(signal_dim, control_dim)``.
        goal: target of the control task, shape ``(signal_dim,)``.

    Raises:
        ValueError: for a size, seed, standard deviation, shape or entry out of range.
        TypeError: for a size or seed that is not an integer.

    Examples:
        >>> system = LinearGaussianSystem(control_dim=2, seed=111)
        >>> system.A[0]
        tensor([-0.5332,  0.1993,  0.8217, -0.0296], dtype=torch.float64)
        >>> data = system.simulate(1000, noise_scale=8.0)
        >>> data.batch_size, data["observation"].shape
        (torch.Size([1000]), torch.Size([1000, 20]))
    """

    def __init__(
        self,
        signal_dim: int = 4,
        distractor_dim: int = 4,
        observation_dim: int = 20,
        control_dim: int = 0,
        *,
        signal_std: float = 0.1,
        distractor_decay: float = 0.9,
        distractor_std: float = 0.3,
        sensor_std: float = 0.01,
        seed: int = 0,
        A: MatrixLike | None = None,
        C: MatrixLike | None = None,
        D: MatrixLike | None = None,
        B: MatrixLike | None = None,
        goal: VectorLike | None = None,
    ) -> None:
        self.signal_dim = check_positive_int("signal_dim", signal_dim)
        self.distractor_dim = check_positive_int("distractor_dim", distractor_dim)
        self.observation_dim = check_positive_int("observation_dim", observation_dim)
        self.control_dim = check_positive_int("control_dim", control_dim, minimum=0)
        self.noise_dim = self.signal_dim + self.distractor_dim + self.observation_dim
        self.signal_std = check_nonnegative("signal_std", signal_std)
        self.distractor_decay = _check_array("distractor_decay", distractor_decay, ()).item()
        self.distractor_std = check_nonnegative("distractor_std", distractor_std)
        self.sensor_std = check_nonnegative("sensor_std", sensor_std)
        self.seed = check_positive_int("seed", seed, minimum=0)
        if self.seed >= 2**32:
            raise ValueError(f"seed must be in [0, 2**32 - 1], got {seed}.")

        S, Dd, X, U = self.signal_dim, self.distractor_dim, self.observation_dim, self.control_dim
        # The legacy generator, because the paper's own program draws its matrices from it.
        rng = np.random.RandomState(self.seed)
        drawn = {"A": np.linalg.qr(rng.randn(S, S))[0]}
        for name, shape in (("C", (X, S)), ("D", (X, Dd)), ("B", (S, U)), ("goal", (S,))):
            value = rng.randn(*shape)
            drawn[name] = value / np.linalg.norm(value, axis=0)
        given = {"A": A, "C": C, "D": D, "B": B, "goal": goal}
        for name, value in drawn.items():
            explicit = given[name]
            chosen = value if explicit is None else explicit
            setattr(self, name, _check_array(name, chosen, value.shape))
        self.generator = torch.Generator().manual_seed(self.seed)

    A: Tensor
    B: Tensor
    C: Tensor
    D: Tensor
    goal: Tensor

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}(signal_dim={self.signal_dim}, "
            f"distractor_dim={self.distractor_dim}, observation_dim={self.observation_dim}, "
            f"control_dim={self.control_dim}, seed={self.seed})"
        )

    def start(self, noise: Tensor, noise_scale: float) -> tuple[Tensor, Tensor, Tensor]:
        """First signal, distractor and observation of a trajectory.

        Args:
            noise: standard normal numbers ``[s_0, d_0, eps_0]``, shape ``(*B, noise_dim)``.
            noise_scale: the distractor's scale ``sigma``, at least 0.

        Returns:
            ``s_0 (*B, signal_dim)``, ``d_0 (*B, distractor_dim)``, ``x_0 (*B, observation_dim)``.

        Examples:
            >>> s, d, x = LinearGaussianSystem().start(torch.zeros(28), noise_scale=1.0)
            >>> x.abs().max()
            tensor(0.)
        """
        signal, distractor, sensor_noise = self._split(noise)
        return signal, distractor, self._observe(signal, distractor, sensor_noise, noise_scale)

    def step(
        self,
        signal: Tensor,
        distractor: Tensor,
        action: Tensor | None,
        noise: Tensor,
        noise_scale: float,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One step of signal and distractor, and the observation after it.

        Args:
            signal: ``s_t``, shape ``(*B, signal_dim)``.
            distractor: ``d_t``, shape ``(*B, distractor_dim)``.
            action: ``u_t``, shape ``(*B, control_dim)``, or None for no control.
            noise: standard normal numbers ``[w_t, v_t, eps_{t+1}]``, shape ``(*B, noise_dim)``.
            noise_scale: the distractor's scale ``sigma``, at least 0.

        Returns:
            ``s_{t+1} (*B, signal_dim)``, ``d_{t+1} (*B, distractor_dim)``, and
            ``x_{t+1} (*B, observation_dim)``.

        Examples:
            >>> system = LinearGaussianSystem(control_dim=2)
            >>> u = torch.tensor([1.0, 0.0])
            >>> s, d, x = system.step(torch.zeros(4), torch.ones(4), u, torch.zeros(28), 0.0)
            >>> torch.allclose(s, system.B[:, 0].float()), d
            (True, tensor([0.9000, 0.9000, 0.9000, 0.9000]))
        """
        w, v, sensor_noise = self._split(noise)
        next_signal = signal @ self.A.to(signal).mT + self.signal_std * w
        if action is not None:
            next_signal = next_signal + action @ self.B.to(signal).mT
        next_distractor = self.distractor_decay * distractor + self.distractor_std * v
        observation = self._observe(next_signal, next_distractor, sensor_noise, noise_scale)
        return next_signal, next_distractor, observation

    def unroll(
        self,
        noise: Tensor,
        noise_scale: float,
        actions: Tensor | None = None,
        *,
        signal: Tensor | None = None,
        distractor: Tensor | None = None,
    ) -> TensorDict:
        """The trajectory that given noise and actions produce; computed in float64.

        Equal to :meth:`start` and repeated :meth:`step`, without a loop over time.

        Args:
            noise: standard normal numbers, shape ``(*B, T, noise_dim)``; see the class docstring.
            noise_scale: the distractor's scale ``sigma``, at least 0.
            actions: ``u``, shape ``(T, control_dim)`` or ``(*B, T, control_dim)``; None is zero.
            signal: ``s_0`` in place of the drawn one, shape ``(signal_dim,)`` or
                ``(*B, signal_dim)``.
            distractor: ``d_0`` in place of the drawn one, shaped likewise.

        Returns:
            A TensorDict of batch size ``(*B, T)`` and the dtype of ``noise`` with ``observation``,
            ``signal``, ``distractor``, ``action`` and ``time`` (int64, ``0 .. T - 1``).

        Raises:
            ValueError: for a wrong shape, a NaN or infinite entry, a negative ``noise_scale``, or
                an unstable system that overflows.

        Examples:
            >>> system = LinearGaussianSystem(signal_std=0.0)
            >>> data = system.unroll(torch.zeros(3, 28), 1.0, signal=torch.ones(4))
            >>> data["signal"].norm(dim=-1)
            tensor([2., 2., 2.])
        """
        noise_scale = check_nonnegative("noise_scale", noise_scale)
        if noise.ndim < 2 or noise.shape[-1] != self.noise_dim or noise.shape[-2] < 1:
            raise ValueError(
                f"noise must have shape (*B, T, noise_dim={self.noise_dim}) with T at least 1, "
                f"got {tuple(noise.shape)}."
            )
        batch_size = noise.shape[:-1]
        self._check_inputs(batch_size, actions, signal, distractor)
        if actions is None:
            actions = noise.new_zeros(self.control_dim)
        actions = actions.to(noise).expand(*batch_size, self.control_dim)
        w, v, sensor_noise = self._split(noise)
        s_0 = w[..., 0, :] if signal is None else signal.to(noise)
        d_0 = v[..., 0, :] if distractor is None else distractor.to(noise)
        controls = actions[..., :-1, :].double() @ self.B.to(noise.device).mT
        signals = _from_start(self.A, s_0, controls + self.signal_std * w[..., 1:, :].double())
        decay = self.distractor_decay * torch.eye(self.distractor_dim, dtype=torch.float64)
        distractors = _from_start(decay, d_0, self.distractor_std * v[..., 1:, :].double())
        signals, distractors = signals.to(noise), distractors.to(noise)
        observations = self._observe(signals, distractors, sensor_noise, noise_scale)
        if not observations.isfinite().all():
            raise ValueError(
                f"the trajectory must be finite, but it overflows or its noise is not finite: A "
                f"has spectral radius {torch.linalg.eigvals(self.A).abs().max():.4g}, "
                f"distractor_decay is {self.distractor_decay:g}, over {batch_size[-1]} steps. "
                "Pass a stable system or fewer steps."
            )
        time = torch.arange(batch_size[-1], device=noise.device).expand(batch_size)
        return TensorDict(
            {
                "observation": observations,
                "signal": signals,
                "distractor": distractors,
                "action": actions.clone(),
                "time": time.clone(),
            },
            batch_size=batch_size,
        )

    def simulate(
        self,
        num_steps: int,
        noise_scale: float,
        actions: Tensor | None = None,
        *,
        batch_size: Sequence[int] = (),
        signal: Tensor | None = None,
        distractor: Tensor | None = None,
        seed: int | None = None,
        generator: torch.Generator | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> TensorDict:
        """Draws trajectories of ``num_steps`` observations.

        Without ``seed`` or ``generator`` the noise comes from ``self.generator``, so that
        successive calls give independent data (say, training and test) and the same system gives
        the same sequence of calls. A million steps take about a second.

        Args:
            num_steps: ``T``, the number of observations, at least 1.
            noise_scale: the distractor's scale ``sigma``, at least 0.
            actions: ``u``, shape ``(T, control_dim)`` or ``(*B, T, control_dim)``; None is zero.
            batch_size: ``*B``, the number of independent trajectories.
            signal: ``s_0``, shape ``(signal_dim,)`` or ``(*B, signal_dim)``; else drawn.
            distractor: ``d_0``, shape ``(distractor_dim,)`` or ``(*B, distractor_dim)``; else
                drawn.
            seed: draws from a fresh generator with this seed.
            generator: draws from this generator, which it advances.
            dtype: dtype of the result.

        Returns:
            A TensorDict of batch size ``(*B, T)``: ``observation (observation_dim)``,
            ``signal (signal_dim)``, ``distractor (distractor_dim)``, ``action (control_dim)``,
            and ``time`` (int64, ``0 .. T - 1``).

        Raises:
            ValueError: for ``num_steps < 1``, a negative ``noise_scale``, a wrong shape, NaN or
                infinite actions, or both ``seed`` and ``generator``.

        Examples:
            >>> system = LinearGaussianSystem(control_dim=2)
            >>> data = system.simulate(50, 4.0, torch.zeros(50, 2), batch_size=(3,), seed=1)
            >>> data.batch_size, data["action"].shape
            (torch.Size([3, 50]), torch.Size([3, 50, 2]))
        """
        num_steps = check_positive_int("num_steps", num_steps)
        batch_size = tuple(check_positive_int("batch_size", size, 0) for size in batch_size)
        check_nonnegative("noise_scale", noise_scale)
        # Before anything is drawn: a refused call must not advance the generator.
        self._check_inputs((*batch_size, num_steps), actions, signal, distractor)
        if seed is not None:
            if generator is not None:
                raise ValueError("seed and generator must not both be given: pass one of them.")
            generator = torch.Generator().manual_seed(seed)
        generator = self.generator if generator is None else generator
        noise = torch.randn(
            (*batch_size, num_steps, self.noise_dim),
            generator=generator,
            dtype=dtype,
            device=generator.device,
        )
        return self.unroll(noise, noise_scale, actions, signal=signal, distractor=distractor)

    def _check_inputs(
        self,
        batch_size: Sequence[int],
        actions: Tensor | None,
        signal: Tensor | None,
        distractor: Tensor | None,
    ) -> None:
        *lead, num_steps = batch_size
        for name, value, shape in (
            ("actions", actions, (num_steps, self.control_dim)),
            ("signal", signal, (self.signal_dim,)),
            ("distractor", distractor, (self.distractor_dim,)),
        ):
            if value is None:
                continue
            if tuple(value.shape) not in (shape, (*lead, *shape)):
                either = f"{shape} or {(*lead, *shape)}" if lead else f"{shape}"
                raise ValueError(f"{name} must have shape {either}, got {tuple(value.shape)}.")
            if not value.isfinite().all():
                raise ValueError(f"{name} must be finite, got NaN or infinite entries.")

    def _split(self, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        sizes = [self.signal_dim, self.distractor_dim, self.observation_dim]
        signal_noise, distractor_noise, sensor_noise = noise.split(sizes, dim=-1)
        return signal_noise, distractor_noise, sensor_noise

    def _observe(
        self, signal: Tensor, distractor: Tensor, sensor_noise: Tensor, noise_scale: float
    ) -> Tensor:
        # x_t = C s_t + D (sigma d_t) + eps_t
        clean = signal @ self.C.to(signal).mT + (noise_scale * distractor) @ self.D.to(signal).mT
        return clean + self.sensor_std * sensor_noise


def _from_start(matrix: Tensor, initial: Tensor, inputs: Tensor) -> Tensor:
    """``x_0 = initial (*B or (), D)``, ``x_t = M x_{t-1} + inputs_{t-1}``, in float64."""
    initial = initial.to(inputs).expand(*inputs.shape[:-2], inputs.shape[-1]).unsqueeze(-2)
    return linear_recurrence(matrix.to(inputs), torch.cat([initial, inputs], dim=-2))
