"""Loads the policies of a run from its folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from envs.base import Env, Interface, interface
from jaxpg import normalization
from jaxpg.config import configuration
from jaxpg.config.configuration import Config
from jaxpg.errors import UserError
from jaxpg.policy import deterministic_policy, value_function
from jaxpg.program.agents import describe_agent, select_agent
from jaxpg.program.backend import prepare
from jaxpg.program.environment import make_env
from jaxpg.program.networks import make_networks
from jaxpg.program.state import Best, Policy
from jaxpg.store import config_file, folder, same_run
from jaxpg.store.checkpoint import Checkpoints
from jaxpg.store.names import rename_interface


class StoredPolicy(NamedTuple):
    """One agent of a run.

    Attributes:
      act: `act(policy, obs) -> action` in [-1, 1], deterministic.
      value: `value(policy, obs) -> V`, the sum of discounted rewards that the critic expects, in units of the reward.
      policy: its parameters; an argument of `act`, so that policies of one kind share a compiled program.
      env: the environment, with the requested changes.
      interface: the environment's interface with unique names; stored, as brax's environments trace a reset to find it.
      config: configuration of the agent as a run of its own, with the changes.
      agent: description such as "seed 3".
      update: updates made when the checkpoint was written.
      has_evaluation: False for the best policy of a run in which no evaluation gave a return; it is the untrained one.
    """

    act: Callable[[Policy, Any], Any]
    value: Callable[[Policy, Any], Any]
    policy: Policy
    env: Env
    interface: Interface
    config: Config
    agent: str
    update: int
    has_evaluation: bool = True

    def describe(self, which: str) -> str:
        """A description of the policy and when it was saved; `which` is "best" or "last"."""
        kind = which if self.has_evaluation else "untrained"
        reason = "" if self.has_evaluation else "no evaluation gave a return; "
        return f"{kind} policy ({reason}saved after {self.update:,} updates)"


def load(
    run: str,
    which: str = "best",
    agent: int | None = None,
    changes: Mapping[str, Any] | None = None,
    divided: bool = False,
) -> StoredPolicy:
    """A policy from a run folder.

    Args:
      run: the folder.
      which: "best" (by the evaluations during training) or "last".
      agent: index of the agent, from 0; None takes the one with the best evaluation.
      changes: options to change, by dotted name; only `env.*` makes sense here.
      divided: whether the process gets a device for each core (`jaxpg.program.backend.prepare`).

    Raises:
      UserError: there is no run folder or no checkpoint, the checkpoint belongs to another run, or there is no such
        agent.
    """
    (stored,) = load_several(run, [which], agent, changes, divided)
    return stored


def load_several(
    run: str,
    kinds: Sequence[str],
    agent: int | None = None,
    changes: Mapping[str, Any] | None = None,
    divided: bool = False,
) -> list[StoredPolicy]:
    """Policies of the same agent in the same environment.

    Args:
      run, agent, changes, divided: as in `load`.
      kinds: each "best" or "last".
    """
    run_folder = folder.find(run)
    stored = config_file.load(run_folder.config)
    config = configuration.change(stored, changes or {})
    prepare(config, divided=divided)  # without this, environments of other libraries may hang
    env = make_env(config)
    shape = _make_template(config, env)
    best, update = _restore(Checkpoints(run_folder.best, read_only=True), shape, stored)
    if agent is None:
        agent = int(np.argmax(best.episode_return))
    if not 0 <= agent < config.num_agents:
        agents = f"agents 0 to {config.num_agents - 1}" if config.num_agents > 1 else "one agent, 0"
        raise UserError(f"agent={agent}: the run has {agents}")
    policies: dict[str, tuple[Policy, int]] = {"best": (best.policy, update)}
    if "last" in kinds:
        policies["last"] = _restore(
            Checkpoints(run_folder.checkpoints, read_only=True), shape.policy, stored, part="train"
        )
    agent_policies = {
        kind: (jax.tree.map(lambda x: np.asarray(x)[agent], policy), at) for kind, (policy, at) in policies.items()
    }
    one = make_stored_policy(select_agent(config, agent), env, *agent_policies["best"], describe_agent(config, agent))
    evaluated = {"best": bool(np.isfinite(best.episode_return[agent])), "last": True}
    return [
        one._replace(policy=agent_policies[kind][0], update=agent_policies[kind][1], has_evaluation=evaluated[kind])
        for kind in kinds
    ]


def make_stored_policy(config: Config, env: Env, policy: Policy, update: int, agent: str) -> StoredPolicy:
    """The policy with `act` and `value` as its configuration defines them; for the arguments see `StoredPolicy`."""
    networks, reward_scale = make_networks(config, env), config.algo.reward_scale

    def act(policy: Policy, obs):
        return deterministic_policy(networks, *policy)(obs)

    def value(policy: Policy, obs):
        return value_function(networks, *policy, reward_scale)(obs)

    return StoredPolicy(act, value, policy, env, rename_interface(interface(env)), config, agent, update)


def _make_template(config: Config, env: Env) -> Best:
    """Shapes and types in the folder `best`, found without optimizer and environments."""
    params = jax.eval_shape(make_networks(config, env).init, jax.random.key(0))
    policy = Policy(params, normalization.init(env.observation_size))
    one = policy, np.float32(0)
    return Best(*jax.tree.map(lambda x: jax.ShapeDtypeStruct((config.num_agents, *x.shape), x.dtype), one))


def _restore(checkpoints: Checkpoints, template: Any, config: Config, part: str = "") -> tuple[Any, int]:
    """The newest checkpoint, or a part of it, and its number of updates; `config` is that of the run folder."""
    update = checkpoints.latest()
    if update is None:
        raise UserError(f"{checkpoints.folder}: no checkpoint yet")
    same_run.check_checkpoint(checkpoints, update, config)
    return checkpoints.restore(update, template, part), update
