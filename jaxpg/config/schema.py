"""The options of a training run: those of each algorithm and network, and of the run itself.

Each field has a default, a help text and a range. Environments set their tuned values in their registry entries.
Options made with `number` can be swept; all others are part of the compiled program.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar

from envs.options import option

# Names of functions, which are imported later; a test compares the names with the tables.
ESTIMATORS = ("td_lambda", "td_zero", "n_step", "monte_carlo")
BASELINES = ("none", "mean", "time_mean", "leave_one_out", "optimal", "value")
RETURNS = ("to_go", "whole")
ACTIVATIONS = ("tanh", "relu", "elu", "swish")
FEATURES = ("identity", "polynomial", "fourier", "radial")
SIGMAS = ("fixed", "learned", "scheduled", "state")
NAN_POLICIES = ("stop", "skip")
LOGGERS = ("wandb", "mlflow")  # besides TensorBoard
LARGEST = 2**31 - 1  # size of an array's axis: XLA's indices are 32-bit numbers


def number(default: float | None, help: str, **bounds: Any) -> Any:
    """An option that can be swept: its value only enters formulas, so it can be an argument of the compiled program.

    Args:
      default, help, bounds: as in `option`.
    """
    metadata = option(default, help, **bounds).metadata
    return dataclasses.field(default=default, metadata={**metadata, "sweepable": True})


@dataclass(frozen=True)
class Common:
    """Options shared by all algorithms, and defaults of those that some lack."""

    gamma: float = number(0.99, "discount", at_least=0, at_most=1)
    reward_scale: float = number(1.0, "factor on the rewards for learning", above=0)
    normalize_observations: bool = option(True, "normalize observations by their running mean and deviation")

    whole_episodes: ClassVar[bool] = False  # whether a rollout is a whole episode
    keeps_rollouts: ClassVar[bool] = True  # whether a whole rollout is in memory
    num_shards: ClassVar[int] = 1
    minibatches: ClassVar[int] = 1
    episode_length: ClassVar[int | None] = None
    gradient_steps: ClassVar[int] = 1  # per update
    has_schedules: ClassVar[bool] = True  # whether step sizes and sigma may follow the run's progress
    final_lr: ClassVar[float] = 1.0
    normalize_advantages: ClassVar[bool] = False


@dataclass(frozen=True)
class Learning(Common):
    """Options shared by TD and REINFORCE."""

    actor_lr: float = number(0.002, "Adam step size of the actor", above=0)
    critic_lr: float = number(0.004, "Adam step size of the critic", above=0)
    final_lr: float = number(0.1, "step sizes decrease linearly to this fraction", at_least=0, at_most=1)
    max_gradient_norm: float = number(1.0, "gradients are clipped to this norm", above=0)
    entropy_coef: float = number(0.0, "weight of the entropy bonus", at_least=0)
    normalize_advantages: bool = option(True, "normalize advantages to mean 0 and deviation 1 over the batch")


@dataclass(frozen=True)
class TD(Learning):
    """Temporal differences: TD(lambda) actor-critic; lambda_=0 is the one-step TD error."""

    estimator: str = option("td_lambda", "advantages; td_zero and monte_carlo are lambda 0 and 1", choices=ESTIMATORS)
    n: int = option(5, "number of rewards summed by n_step", at_least=1)
    lambda_: float = number(0.95, "weight of longer returns; 0 is TD(0), 1 is Monte Carlo", at_least=0, at_most=1)
    episode_length: int | None = option(
        None, "steps after which training episodes are cut [default: the environment's]", at_least=1
    )
    num_shards: int = option(
        1, "parts of the environments, each on its own core or device; divides num_envs", at_least=1, at_most=1024
    )


@dataclass(frozen=True)
class PPO(TD):
    """Proximal policy optimization: TD with several gradient steps on the clipped surrogate per rollout."""

    epochs: int = option(10, "passes over each rollout", at_least=1)
    minibatches: int = option(1, "gradient steps per pass; divides num_envs", at_least=1)
    clip: float | None = number(0.2, "clip the probability ratio to 1 +- this; null: no clipping", above=0)
    value_clip: float | None = number(None, "clip values to within this of the rollout's; null: no clipping", above=0)
    max_kl: float | None = number(
        None, "skip steps beyond this KL divergence from the old policy; null: no limit", above=0
    )

    @property
    def gradient_steps(self) -> int:
        return self.epochs * self.minibatches


@dataclass(frozen=True)
class Reinforce(Learning):
    """REINFORCE: complete episodes, Monte Carlo returns."""

    whole_episodes: ClassVar[bool] = True

    baseline: str = option("value", "baseline subtracted from the return", choices=BASELINES)
    returns: str = option("to_go", "return from each step on, or of the whole episode", choices=RETURNS)
    discounted: bool = option(False, "multiply advantages by gamma^t, for the gradient of the objective")


@dataclass(frozen=True)
class Online(Common):
    """Per-step actor-critic: a plain gradient update after every step, with eligibility traces."""

    keeps_rollouts: ClassVar[bool] = False
    has_schedules: ClassVar[bool] = False

    lambda_actor: float = number(0.9, "decay of the actor's trace; 0 is no trace", at_least=0, at_most=1)
    lambda_critic: float = number(0.9, "decay of the critic's trace", at_least=0, at_most=1)
    actor_lr: float = number(0.001, "step size of the actor", above=0)
    critic_lr: float = number(0.005, "step size of the critic", above=0)
    discounted: bool = option(False, "multiply the actor's gradient by gamma^t")


@dataclass(frozen=True)
class Gaussian:
    """Options of the Gaussian policy, shared by all networks, and defaults of those that some lack."""

    widths: ClassVar[list[int]] = []
    activation: ClassVar[str] = "tanh"
    features: ClassVar[str] = "identity"
    order: ClassVar[int] = 1

    sigma: float = number(0.5, "initial standard deviation of the policy, before tanh", above=0)
    sigma_is: str = option(
        "learned", "sigma: constant, a parameter, a schedule, or a function of the state", choices=SIGMAS
    )
    final_sigma: float = option(0.1, "last sigma of sigma_is=scheduled, reached geometrically", above=0)
    squash: bool = option(True, "squash actions into their limits by tanh")


@dataclass(frozen=True)
class MLP(Gaussian):
    """Separate multilayer perceptrons for actor and critic, over fixed features of the observation."""

    widths: list[int] = option([64, 64], "hidden units of each layer", at_least=1)
    activation: str = option("tanh", "activation of the hidden layers", choices=ACTIVATIONS)
    features: str = option("identity", "features of the observation for the first layer", choices=FEATURES)
    order: int = option(2, "degree, highest frequency, or grid points per axis", at_least=1)


@dataclass(frozen=True)
class Linear(Gaussian):
    """Mean and value linear in fixed features of the observation."""

    features: str = option("identity", "features of the observation", choices=FEATURES)
    order: int = option(2, "degree, highest frequency, or grid points per axis", at_least=1)


@dataclass(frozen=True)
class Run:
    """Options of the run itself."""

    seed: int = option(0, "random seed", at_least=0, at_most=2**32 - 1)
    num_seeds: int = option(
        1,
        "agents trained at once (for each setting of a sweep), with seeds seed, seed + 1, ...",
        at_least=1,
        at_most=LARGEST,
    )
    vmap_seeds: int = option(1, "agents per compiled program; on a CPU 1 is fastest", at_least=1)
    num_envs: int = option(64, "environments per agent", at_least=1, at_most=LARGEST)
    num_steps: int | None = option(None, "steps of a rollout (td); reinforce plays whole episodes", at_least=1)
    total_steps: int = option(1_000_000, "environment steps of training per agent", at_least=1)
    log_interval: int = option(50_000, "environment steps between lines of metrics", at_least=1)
    eval_interval: int = option(250_000, "environment steps between evaluations", at_least=1)
    eval_episodes: int = option(512, "episodes per evaluation", at_least=1)
    stop_return: float | None = option(None, "stop early at an evaluation with this return; null: do not")
    stop_agents: str = option("all", "whether all agents or one must reach stop_return", choices=("all", "one"))
    nan_policy: str = option(
        "stop",
        "at an update that is not finite, stop the agent or skip the update",
        choices=NAN_POLICIES,
    )
    checkpoint_interval: int = option(5_000_000, "environment steps between checkpoints", at_least=1)
    run_dir: str | None = option(None, "run folder [default: runs/<env>-<algo>-s<seed>-<time>]")
    loggers: list[str] = option([], "loggers besides TensorBoard", choices=LOGGERS)
    cache: bool = option(True, "keep compiled programs in the user's cache folder")
    report: bool = option(True, "write report.html at the end, with curves and episodes")

    @property
    def rollout_steps(self) -> int:
        """`num_steps`, which is set in every checked configuration."""
        assert self.num_steps is not None
        return self.num_steps
