"""A linear-quadratic problem, on which everything about a linear-Gaussian policy is known in closed form.

    s_{t+1} = A s_t + B a_t + w_t,    w_t ~ N(0, W),    s_0 ~ N(m_0, S_0)
    r_t     = -(s_{t+1}' Q s_{t+1} + a_t' R a_t)
    a_t     ~ N(K s_t + k, sigma^2 I)

for T steps, with discount gamma. Under the policy the value is quadratic in the state, V_t(s) = -(s' P_t s + 2 p_t' s +
c_t), and comes from a recursion backwards in time; the states are Gaussian, and their moments come from a recursion
forwards. Both together give J and its gradient. All of this is plain numpy in float64: it is what estimators are tested
against.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


@dataclass(frozen=True)
class Problem:
    """A linear-quadratic problem with n state and m action variables.

    Attributes:
      A, B: dynamics, `[n, n]` and `[n, m]`.
      Q, R: costs of the next state and of the action, symmetric, `[n, n]` and `[m, m]`; R positive definite.
      W: covariance of the noise on the state, `[n, n]`.
      initial_mean, initial_covariance: of s_0, `[n]` and `[n, n]`.
      horizon: T.
      discount: gamma, in [0, 1].
    """

    A: np.ndarray
    B: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    W: np.ndarray
    initial_mean: np.ndarray
    initial_covariance: np.ndarray
    horizon: int
    discount: float


class Policy(NamedTuple):
    """a ~ N(K s + k, sigma^2 I): `K` `[m, n]`, `k` `[m]`, `sigma` a number."""

    K: np.ndarray
    k: np.ndarray
    sigma: float


class Quadratic(NamedTuple):
    """x -> -(x' P x + 2 p' x + c), with P symmetric."""

    P: np.ndarray
    p: np.ndarray
    c: float

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """The value at `[..., n]`, `[...]`."""
        return -(np.einsum("...i,ij,...j", x, self.P, x) + 2 * x @ self.p + self.c)


def values(problem: Problem, policy: Policy) -> list[Quadratic]:
    """V_t(s) for t = 0 ... T, each a `Quadratic` of s; V_T = 0, V_t = `backup` of V_{t+1}."""
    found = [zero(problem)]
    for _ in range(problem.horizon):
        found.append(backup(problem, policy, found[-1]))
    return found[::-1]


def zero(problem: Problem) -> Quadratic:
    """The value of every state when no reward is to come."""
    return Quadratic(np.zeros_like(problem.A), np.zeros(len(problem.A)), 0.0)


def backup(problem: Problem, policy: Policy, following: Quadratic) -> Quadratic:
    """s -> E[r_t + gamma following(s_{t+1}) | s_t = s] under the policy.

    With (P, p, c) of `action_value` and the actions a = K s + k + sigma epsilon, (s, K s + k) = L s + o:

        L' P L,    L' (P o + p),    o' P o + 2 p' o + c + sigma^2 tr(P_aa)
    """
    K, k, sigma = policy
    n = len(problem.A)
    P, p, c = action_value(problem, following)
    L, o = np.concatenate([np.eye(n), K]), np.concatenate([np.zeros(n), k])
    return Quadratic(L.T @ P @ L, L.T @ (P @ o + p), o @ P @ o + 2 * p @ o + c + sigma**2 * np.trace(P[n:, n:]))


def action_value(problem: Problem, following: Quadratic) -> Quadratic:
    """(s, a) -> E[r_t + gamma following(s_{t+1}) | s_t = s, a_t = a], of the vector that joins s and a.

    Q_t is that of V_{t+1}. With following = -(x' P x + 2 p' x + c), M = Q + gamma P, and E = (A, B) side by side:

        E' M E + diag(0, R),    gamma E' p,    tr(M W) + gamma c
    """
    both = np.concatenate([problem.A, problem.B], axis=1)
    n = len(problem.A)
    M = problem.Q + problem.discount * following.P
    P = both.T @ M @ both
    P[n:, n:] += problem.R
    constant = np.trace(M @ problem.W) + problem.discount * following.c
    return Quadratic(P, problem.discount * both.T @ following.p, constant)


def lambda_targets(problem: Problem, policy: Policy, critic: list[Quadratic], lambda_: float) -> list[Quadratic]:
    """What TD(lambda) bootstraps from at s_{t+1}, on average, for t = 0 ... T - 1.

        following_t = (1 - lambda) critic_{t+1} + lambda E[G^lambda_{t+1} | s_{t+1}]

    lambda = 0 is the critic itself, lambda = 1 the policy's own value, whatever the critic says.

    Args:
      problem, policy: as above.
      critic: T + 1 values that somebody believes in, exact or not; the last one is of states in which all is over.
      lambda_: in [0, 1].
    """

    def mix(x, y):
        return (1 - lambda_) * x + lambda_ * y

    target, found = critic[-1], []
    for believed in critic[:0:-1]:
        found.append(Quadratic(mix(believed.P, target.P), mix(believed.p, target.p), mix(believed.c, target.c)))
        target = backup(problem, policy, found[-1])
    return found[::-1]


def objective(problem: Problem, policy: Policy) -> float:
    """J = E[sum_t gamma^t r_t] = E[V_0(s_0)]."""
    value = values(problem, policy)[0]
    return float(value(problem.initial_mean) - np.trace(value.P @ problem.initial_covariance))


def state_moments(problem: Problem, policy: Policy) -> list[tuple[np.ndarray, np.ndarray]]:
    """(E[s_t], E[s_t s_t']) for t = 0 ... T - 1 under the policy."""
    A, B = problem.A, problem.B
    F, drift = A + B @ policy.K, B @ policy.k
    noise = policy.sigma**2 * B @ B.T + problem.W
    mean, covariance = problem.initial_mean, problem.initial_covariance
    found = []
    for _ in range(problem.horizon):
        found.append((mean, covariance + np.outer(mean, mean)))
        mean, covariance = F @ mean + drift, F @ covariance @ F.T + noise
    return found


def gradient(
    problem: Problem, policy: Policy, following: list[Quadratic] | None = None, discounted: bool = True
) -> Policy:
    """The gradient of J with respect to K, k and log sigma (in the place of sigma), by the policy-gradient theorem.

        dJ/dK         = sum_t gamma^t E[g_t(s_t) s_t'],    g_t(s) = -2 (P_aa (K s + k) + P_as s + p_a)
        dJ/dk         = sum_t gamma^t E[g_t(s_t)]
        dJ/dlog sigma = -2 sigma^2 sum_t gamma^t tr(P_aa)

    where g_t(s) = E[grad_a Q_t(s, a)], and P, p are those of Q_t, the `action_value` of V_{t+1}.

    Args:
      problem, policy: as above.
      following: T quadratics in the place of V_{t+1}: those of `lambda_targets` give the mean of the gradient that
        TD(lambda) estimates with a critic that is wrong. None: the policy's own values.
      discounted: without it the factors gamma^t are left out, as in the lesson's section 3 and in most programs. That
        sum is the mean of the estimators that leave them out; it is not the gradient of J.
    """
    K, k, sigma = policy
    n = len(problem.A)
    dK, dk, dlog_sigma = np.zeros_like(K), np.zeros_like(k), 0.0
    following = values(problem, policy)[1:] if following is None else following
    for t, (mean, second) in enumerate(state_moments(problem, policy)):
        P, p, _ = action_value(problem, following[t])
        slope, offset = P[n:, n:] @ K + P[n:, :n], P[n:, n:] @ k + p[n:]
        factor = -2 * (problem.discount**t if discounted else 1.0)
        dK = dK + factor * (slope @ second + np.outer(offset, mean))
        dk = dk + factor * (slope @ mean + offset)
        dlog_sigma = dlog_sigma + factor * sigma**2 * np.trace(P[n:, n:])
    return Policy(dK, dk, float(dlog_sigma))


def best_policy(problem: Problem, sigma: float) -> Policy:
    """The K and k of the largest J among the policies that are the same at every step, with this sigma.

    Found by following the gradient in closed form, from the first of the `riccati_gains`; J is not concave in K, so it
    is a local best only. Raises RuntimeError where the search does not end.
    """
    import scipy.optimize  # slow to import, and seldom needed

    n, m = problem.B.shape

    def unpack(x):
        return Policy(x[: m * n].reshape(m, n), x[m * n :], sigma)

    def loss(x):
        slope = gradient(problem, unpack(x))
        return -objective(problem, unpack(x)), -np.concatenate([slope.K.ravel(), slope.k])

    start = np.concatenate([riccati_gains(problem)[0].ravel(), np.zeros(m)])
    found = scipy.optimize.minimize(loss, start, jac=True, method="BFGS", options={"gtol": 1e-7})
    if not found.success:
        raise RuntimeError(f"no best policy found: {found.message}")
    return unpack(found.x)


def riccati_gains(problem: Problem) -> list[np.ndarray]:
    """The optimal K_t for t = 0 ... T - 1: the policy that nothing beats, deterministic and different at each step.

    K_t = -P_aa^-1 P_as    of Q_t, the `action_value` of what the later gains earn
    """
    n, m = problem.B.shape
    following, gains = zero(problem), []
    for _ in range(problem.horizon):
        P = action_value(problem, following).P
        gains.append(-np.linalg.solve(P[n:, n:], P[n:, :n]))
        following = backup(problem, Policy(gains[-1], np.zeros(m), 0.0), following)
    return gains[::-1]


def optimum(problem: Problem) -> float:
    """J of the `riccati_gains`, the largest there is: E[V_0(s_0)]."""
    following = zero(problem)
    for K in reversed(riccati_gains(problem)):
        following = backup(problem, Policy(K, np.zeros(len(K)), 0.0), following)
    return float(following(problem.initial_mean) - np.trace(following.P @ problem.initial_covariance))
