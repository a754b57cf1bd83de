"""The policies of a run, read back from its folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from envs.base import Interface, interface
from jaxpg import normalization
from jaxpg.config import configuration
from jaxpg.config.configuration import Config
from jaxpg.errors import UserError
from jaxpg.policy import deterministic_policy, value_function
from jaxpg.program.agents import alone, described_agent
from jaxpg.program.backend import prepare
from jaxpg.program.environment import make_env
from jaxpg.program.networks import make_networks
from jaxpg.program.state import Best, Policy
from jaxpg.store import config_file, folder, same_run
from jaxpg.store.checkpoint import Checkpoints
from jaxpg.store.names import own_interface


class StoredPolicy(NamedTuple):
    """One agent of a run.

    Attributes:
      act: `act(policy, obs) -> action` in [-1, 1], deterministic.
      value: `value(policy, obs) -> V`, what the critic expects of the discounted rewards to come, in their units.
      policy: its parameters; an argument of `act`, so that all policies of a kind are one compiled program.
      env: the environment, with the changes asked for.
      interface: what its numbers are, each with a name of its own; kept, as brax's environments trace a reset to know
        how many they have.
      config: of the agent as a run of its own, with the changes.
      agent: in words, such as "seed 3".
      update: updates made when the checkpoint was written.
      evaluated: whether it was chosen by a return; False for the best policy of a run none of whose evaluations gave
        one, which is the untrained one.
    """

    act: Callable[[Policy, Any], Any]
    value: Callable[[Policy, Any], Any]
    policy: Policy
    env: Any
    interface: Interface
    config: Config
    agent: str
    update: int
    evaluated: bool = True

    def described(self, which: str) -> str:
        """What it is and when it was saved, in words; `which` is how it was asked for, "best" or "last"."""
        kind = which if self.evaluated else "untrained"
        reason = "" if self.evaluated else "no evaluation gave a return to choose another by; "
        return f"{kind} policy ({reason}saved after {self.update:,} updates)"


def load(
    run: str, which: str = "best", agent: int | None = None, changes: Mapping[str, Any] | None = None
) -> StoredPolicy:
    """A policy from a run folder.

    Args:
      run: the folder.
      which: "best" (by the evaluations while training) or "last".
      agent: which of the run's agents, from 0; None takes the one with the best evaluation.
      changes: options to change, by dotted name; `env.*` alone makes sense here.

    Raises:
      UserError: no run folder, no checkpoint in it, one of another run, or no such agent.
    """
    (stored,) = load_several(run, [which], agent, changes)
    return stored


def load_several(
    run: str, kinds: Sequence[str], agent: int | None = None, changes: Mapping[str, Any] | None = None
) -> list[StoredPolicy]:
    """Policies of the same agent, which act in the same environment; arguments as in `load`.

    Args:
      run, agent, changes: as above.
      kinds: of "best" and "last".
    """
    run_folder = folder.find(run)
    stored = config_file.load(run_folder.config)
    config = configuration.change(stored, changes or {})
    prepare(config)  # environments of other libraries may hang without
    env = make_env(config)
    shape = _shape(config, env)
    best, update = _restore(Checkpoints(run_folder.best, read_only=True), shape, stored)
    if agent is None:
        agent = int(np.argmax(best.episode_return))
    if not 0 <= agent < config.num_agents:
        raise UserError(f"agent={agent}: the run has agents 0 to {config.num_agents - 1}")
    found: dict[str, tuple[Policy, int]] = {"best": (best.policy, update)}
    if "last" in kinds:
        found["last"] = _restore(
            Checkpoints(run_folder.checkpoints, read_only=True), shape.policy, stored, part="train"
        )
    of_agent = {
        kind: (jax.tree.map(lambda x: np.asarray(x)[agent], policy), at) for kind, (policy, at) in found.items()
    }
    one = stored_policy(alone(config, agent), env, *of_agent["best"], described_agent(config, agent))
    evaluated = {"best": bool(np.isfinite(best.episode_return[agent])), "last": True}
    return [
        one._replace(policy=of_agent[kind][0], update=of_agent[kind][1], evaluated=evaluated[kind]) for kind in kinds
    ]


def stored_policy(config: Config, env: Any, policy: Policy, update: int, agent: str) -> StoredPolicy:
    """A policy that acts and values as its configuration says; arguments as the attributes of `StoredPolicy`."""
    networks, reward_scale = make_networks(config, env), config.algo.reward_scale

    def act(policy, obs):
        return deterministic_policy(networks, *policy)(obs)

    def value(policy, obs):
        return value_function(networks, *policy, reward_scale)(obs)

    return StoredPolicy(act, value, policy, env, own_interface(interface(env)), config, agent, update)


def _shape(config: Config, env: Any) -> Best:
    """Shapes and types of what the folder `best` holds; neither optimizer nor environments are needed to know them."""
    params = jax.eval_shape(make_networks(config, env).init, jax.random.key(0))
    one = Best(Policy(params, normalization.init(env.observation_size)), np.float32(0))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((config.num_agents, *x.shape), x.dtype), one)


def _restore(checkpoints: Checkpoints, template: Any, config: Config, part: str = "") -> tuple[Any, int]:
    """The newest checkpoint, or a part of it, and the updates made before; `config` is that of the run folder."""
    update = checkpoints.latest()
    if update is None:
        raise UserError(f"{checkpoints.folder}: no checkpoint yet")
    same_run.check_checkpoint(checkpoints, update, config)
    return checkpoints.restore(update, template, part), update
