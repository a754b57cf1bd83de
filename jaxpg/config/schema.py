"""The options of a training run: those of each algorithm and network, and the run's own.

Each field has its default, its help and its range. What an environment has its own tuned value for, it says in its
registry entry. Those made with `number` can be swept; all others are part of the program.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar

from envs.options import option

# The names of functions that are imported later; a test compares them.
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
    """An option whose value only enters formulas: the program can take it as an argument, so that it can be swept.

    Args:
      default, help: as in `option`.
      bounds: those of `option`.
    """
    metadata = option(default, help, **bounds).metadata
    return dataclasses.field(default=default, metadata={**metadata, "sweepable": True})


@dataclass(frozen=True)
class Common:
    """Options that all algorithms share, and what the others do without."""

    whole_episodes: ClassVar[bool] = False  # a rollout is as long as an episode
    keeps_rollouts: ClassVar[bool] = True  # all of one is in memory, to be learned from
    num_shards: ClassVar[int] = 1
    minibatches: ClassVar[int] = 1
    episode_length: ClassVar[int | None] = None
    gradient_steps: ClassVar[int] = 1  # of an update
    has_schedules: ClassVar[bool] = True  # step sizes and sigma may follow the run's progress
    final_lr: ClassVar[float] = 1.0
    normalize_advantages: ClassVar[bool] = False
    gamma: float = number(0.99, "discount", at_least=0, at_most=1)
    reward_scale: float = number(1.0, "factor on the rewards that are learned from", above=0)
    normalize_observations: bool = option(True, "observations with running mean 0 and deviation 1")


@dataclass(frozen=True)
class Learning(Common):
    """Options that TD and REINFORCE share."""

    actor_lr: float = number(0.002, "Adam step size of the actor", above=0)
    critic_lr: float = number(0.004, "Adam step size of the critic", above=0)
    final_lr: float = number(0.1, "step sizes fall linearly to this fraction", at_least=0, at_most=1)
    max_gradient_norm: float = number(1.0, "longer gradients are shortened to this", above=0)
    entropy_coef: float = number(0.0, "weight of the entropy bonus", at_least=0)
    normalize_advantages: bool = option(True, "advantages with mean 0 and deviation 1 over the batch")


@dataclass(frozen=True)
class TD(Learning):
    """Temporal differences: TD(lambda) actor-critic; lambda_=0 is the one-step TD error."""

    estimator: str = option("td_lambda", "advantage: td_zero and monte_carlo are lambda 0 and 1", choices=ESTIMATORS)
    n: int = option(5, "rewards that n_step sums", at_least=1)
    lambda_: float = number(0.95, "weight of longer returns: 0 is TD(0), 1 Monte Carlo", at_least=0, at_most=1)
    episode_length: int | None = option(
        None, "steps after which a training episode is cut and begun anew [default: the environment's]", at_least=1
    )
    num_shards: int = option(
        1, "parts of the environments, each on a core or device of its own; divides num_envs", at_least=1, at_most=1024
    )


@dataclass(frozen=True)
class PPO(TD):
    """Proximal policy optimization: TD with several gradient steps on the clipped surrogate for each rollout."""

    epochs: int = option(10, "passes over a rollout", at_least=1)
    minibatches: int = option(1, "gradient steps of a pass; divides num_envs", at_least=1)
    clip: float | None = number(0.2, "the ratio of the probabilities is clipped at 1 +- this; null: not", above=0)
    value_clip: float | None = number(None, "values are held within this of the rollout's; null: not", above=0)
    max_kl: float | None = number(None, "steps end at this KL divergence from the rollout's policy; null: not", above=0)

    @property
    def gradient_steps(self) -> int:
        return self.epochs * self.minibatches


@dataclass(frozen=True)
class Reinforce(Learning):
    """REINFORCE: complete episodes, Monte Carlo returns."""

    whole_episodes: ClassVar[bool] = True

    baseline: str = option("value", "what is subtracted from the return", choices=BASELINES)
    returns: str = option("to_go", "from each step on, or of the whole episode", choices=RETURNS)
    discounted: bool = option(False, "advantages times gamma^t, as the gradient of the objective has them")


@dataclass(frozen=True)
class Online(Common):
    """Per-step actor-critic: after every step, plain steps along eligibility traces."""

    keeps_rollouts: ClassVar[bool] = False
    has_schedules: ClassVar[bool] = False

    lambda_actor: float = number(
        0.9, "decay of the actor's trace; 0 is the gradient of the step alone", at_least=0, at_most=1
    )
    lambda_critic: float = number(0.9, "decay of the critic's trace", at_least=0, at_most=1)
    actor_lr: float = number(0.001, "step size of the actor", above=0)
    critic_lr: float = number(0.005, "step size of the critic", above=0)
    discounted: bool = option(False, "the actor's gradient times gamma^t")


@dataclass(frozen=True)
class Gaussian:
    """Options of the Gaussian policy that all networks share, and what the others do without."""

    widths: ClassVar[list[int]] = []
    activation: ClassVar[str] = "tanh"
    features: ClassVar[str] = "identity"
    order: ClassVar[int] = 1

    sigma: float = number(0.5, "standard deviation of the policy at the beginning, before tanh", above=0)
    sigma_is: str = option(
        "learned", "how it goes on: a parameter, a schedule, a function of the state", choices=SIGMAS
    )
    final_sigma: float = option(0.1, "where sigma_is=scheduled takes it, by equal factors", above=0)
    squash: bool = option(True, "actions tanh(u), within the limits; else u itself")


@dataclass(frozen=True)
class MLP(Gaussian):
    """Separate multilayer perceptrons for actor and critic, of fixed features of the observation."""

    widths: list[int] = option([64, 64], "hidden units by layer", at_least=1)
    activation: str = option("tanh", "activation of the hidden layers", choices=ACTIVATIONS)
    features: str = option("identity", "what the first layer sees", choices=FEATURES)
    order: int = option(2, "degree, highest frequency, or grid points of an axis", at_least=1)


@dataclass(frozen=True)
class Linear(Gaussian):
    """Mean and value linear in fixed features of the observation."""

    features: str = option("identity", "what they are linear in", choices=FEATURES)
    order: int = option(2, "degree, highest frequency, or grid points of an axis", at_least=1)


@dataclass(frozen=True)
class Run:
    """Options of the run itself."""

    seed: int = option(0, "random seed", at_least=0, at_most=2**32 - 1)
    num_seeds: int = option(
        1,
        "agents trained at once (of each setting of a sweep), with seeds seed, seed + 1, ...",
        at_least=1,
        at_most=LARGEST,
    )
    vmap_seeds: int = option(1, "of all agents in one program; on a CPU programs of one agent are faster", at_least=1)
    num_envs: int = option(64, "environments of each agent", at_least=1, at_most=LARGEST)
    num_steps: int | None = option(None, "steps of a rollout (td); reinforce plays whole episodes", at_least=1)
    total_steps: int = option(1_000_000, "environment steps to train for, of each agent", at_least=1)
    log_interval: int = option(50_000, "environment steps between two lines of metrics", at_least=1)
    eval_interval: int = option(250_000, "environment steps between two evaluations", at_least=1)
    eval_episodes: int = option(512, "episodes of an evaluation", at_least=1)
    stop_return: float | None = option(None, "the run ends early at an evaluation with this return; null: not")
    stop_agents: str = option("all", "of several agents, which must have reached it", choices=("all", "one"))
    nan_policy: str = option(
        "stop",
        "an update whose numbers are not finite: its agent stops before it, or goes on without",
        choices=NAN_POLICIES,
    )
    checkpoint_interval: int = option(5_000_000, "environment steps between two checkpoints", at_least=1)
    run_dir: str | None = option(None, "run folder [default: runs/<env>-<algo>-s<seed>-<time>]")
    loggers: list[str] = option([], "where metrics go besides TensorBoard", choices=LOGGERS)
    cache: bool = option(True, "keep compiled programs in the user's cache folder, for the next run")
    report: bool = option(True, "end with report.html: curves, and episodes to watch")

    @property
    def rollout_steps(self) -> int:
        """`num_steps`, which a checked configuration always has."""
        assert self.num_steps is not None
        return self.num_steps
