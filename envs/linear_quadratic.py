"""A linear-quadratic problem, for which everything about a linear-Gaussian policy has a closed form.

    s_{t+1} = A s_t + B a_t + w_t,    w_t ~ N(0, W),    s_0 ~ N(m_0, S_0)
    r_t     = -(s_{t+1}' Q s_{t+1} + a_t' R a_t)
    a_t     ~ N(K s_t + k, sigma^2 I)

for T steps, with discount gamma. Under the policy the value is quadratic in the state, V_t(s) = -(s' P_t s + 2 p_t' s +
c_t), and follows from a backward recursion; the states are Gaussian, and their moments follow from a forward recursion.
Together they give J and its gradient. Everything is plain numpy in float64, as a reference for testing estimators.
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
      initial_mean, initial_covariance: mean and covariance of s_0, `[n]` and `[n, n]`.
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
        """The value `[...]` at x, `[..., n]`."""
        return -(np.einsum("...i,ij,...j", x, self.P, x) + 2 * x @ self.p + self.c)


def values(problem: Problem, policy: Policy) -> list[Quadratic]:
    """V_t(s) for t = 0 ... T, each a `Quadratic` of s; V_T = 0, V_t = `backup` of V_{t+1}."""
    quadratics = [zero(problem)]
    for _ in range(problem.horizon):
        quadratics.append(backup(problem, policy, quadratics[-1]))
    return quadratics[::-1]


def zero(problem: Problem) -> Quadratic:
    """The value of every state after the last reward: 0."""
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
    """(s, a) -> E[r_t + gamma following(s_{t+1}) | s_t = s, a_t = a], a function of s and a concatenated.

    With following = V_{t+1} this is Q_t. With following = -(x' P x + 2 p' x + c), M = Q + gamma P and E = (A, B):

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
    """The mean value from which TD(lambda) bootstraps at s_{t+1}, for t = 0 ... T - 1.

        following_t = (1 - lambda) critic_{t+1} + lambda E[G^lambda_{t+1} | s_{t+1}]

    lambda = 0 gives the critic itself; lambda = 1 gives the value of the policy, whatever the critic.

    Args:
      problem, policy: as in `backup`.
      critic: T + 1 estimated values, exact or not; the last one is for states after the end.
      lambda_: lambda, in [0, 1].
    """

    def mix(x, y):
        return (1 - lambda_) * x + lambda_ * y

    target, targets = critic[-1], []
    for value in critic[:0:-1]:
        targets.append(Quadratic(mix(value.P, target.P), mix(value.p, target.p), mix(value.c, target.c)))
        target = backup(problem, policy, targets[-1])
    return targets[::-1]


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
    moments = []
    for _ in range(problem.horizon):
        moments.append((mean, covariance + np.outer(mean, mean)))
        mean, covariance = F @ mean + drift, F @ covariance @ F.T + noise
    return moments


def gradient(
    problem: Problem, policy: Policy, following: list[Quadratic] | None = None, discounted: bool = True
) -> Policy:
    """The gradient of J with respect to K, k and log sigma (returned as `sigma`), by the policy-gradient theorem.

        dJ/dK         = sum_t gamma^t E[g_t(s_t) s_t'],    g_t(s) = -2 (P_aa (K s + k) + P_as s + p_a)
        dJ/dk         = sum_t gamma^t E[g_t(s_t)]
        dJ/dlog sigma = -2 sigma^2 sum_t gamma^t tr(P_aa)

    where g_t(s) = E[grad_a Q_t(s, a)], and P, p are those of Q_t, the `action_value` of V_{t+1}.

    Args:
      problem, policy: as in `backup`.
      following: T quadratics to use instead of V_{t+1}; those of `lambda_targets` give the mean of TD(lambda)'s
        estimate with a wrong critic. None uses the values of the policy.
      discounted: if False, the factors gamma^t are left out, as in the lesson's section 3 and in most programs. The
        result is then the mean of the estimators without these factors, not the gradient of J.
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
    """The K and k with the largest J among the policies that do not change with time, for a given sigma.

    The search follows the closed-form gradient from the first of the `riccati_gains`. J is not concave in K, so the
    result is a local optimum. Raises RuntimeError if the search does not converge.
    """
    import scipy.optimize  # slow to import, and rarely needed

    n, m = problem.B.shape

    def unpack(x):
        return Policy(x[: m * n].reshape(m, n), x[m * n :], sigma)

    def loss(x):
        slope = gradient(problem, unpack(x))
        return -objective(problem, unpack(x)), -np.concatenate([slope.K.ravel(), slope.k])

    start = np.concatenate([riccati_gains(problem)[0].ravel(), np.zeros(m)])
    result = scipy.optimize.minimize(loss, start, jac=True, method="BFGS", options={"gtol": 1e-7})
    if not result.success:
        raise RuntimeError(f"no best policy found: {result.message}")
    return unpack(result.x)


def riccati_gains(problem: Problem) -> list[np.ndarray]:
    """The optimal K_t for t = 0 ... T - 1: the best policy of all, deterministic and different at each step.

    K_t = -P_aa^-1 P_as    of Q_t, the `action_value` with the value of the later gains
    """
    n, m = problem.B.shape
    following, gains = zero(problem), []
    for _ in range(problem.horizon):
        P = action_value(problem, following).P
        gains.append(-np.linalg.solve(P[n:, n:], P[n:, :n]))
        following = backup(problem, Policy(gains[-1], np.zeros(m), 0.0), following)
    return gains[::-1]


def optimum(problem: Problem) -> float:
    """J of the `riccati_gains`, the largest possible: E[V_0(s_0)]."""
    following = zero(problem)
    for K in reversed(riccati_gains(problem)):
        following = backup(problem, Policy(K, np.zeros(len(K)), 0.0), following)
    return float(following(problem.initial_mean) - np.trace(following.P @ problem.initial_covariance))
