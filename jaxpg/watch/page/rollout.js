// What the linked views share: which episode of which policy, and where in it.

import { clamp, unpack } from "./numbers.js";

/** A state whose listeners are called with the names that have changed. */
export function shared(state) {
  const listeners = [];
  return {
    state,
    listen: (listener) => listeners.push(listener),
    set(changes) {
      const changed = Object.keys(changes).filter((name) => state[name] !== changes[name]);
      Object.assign(state, changes);
      if (changed.length) for (const listener of listeners) listener(new Set(changed));
    },
  };
}

/** The state at the start: the last but one policy is the best where there are three, so the second is shown. */
export function startOf(data) {
  const policies = data.player?.policies ?? data.workspace?.pictures[0].points ?? data.portrait?.values ?? [];
  return { policy: Math.min(1, policies.length - 1), episode: 0, position: 0, speed: 1, playing: false, ghost: false };
}

const recordings = new WeakMap();

/** An episode with its numbers unpacked, and its return up to each frame. */
function recorded(episode) {
  if (!recordings.has(episode)) {
    const packed = ["parts", "motors", "qpos", "shifts"].filter((name) => episode[name]);
    const unpacked = Object.fromEntries(packed.map((name) => [name, unpack(episode[name])]));
    recordings.set(episode, { ...episode, ...unpacked, soFar: episode.so_far ?? returnsSoFar(episode) });
  }
  return recordings.get(episode);
}

/** Sums of the rewards; null where they are not the episode's return, as when only every second step is recorded. */
function returnsSoFar(episode) {
  const sums = [0];
  for (const reward of episode.series.reward ?? []) sums.push(sums.at(-1) + (reward ?? 0));
  const wrong = Math.abs(sums.at(-1) - episode.return);
  return episode.return !== null && wrong <= 0.001 * Math.abs(episode.return) + 0.01 ? sums : null;
}

/** The episode that is chosen. */
export function chosen(player, state) {
  return recorded(player.policies[state.policy].episodes[state.episode]);
}

/** The same episode by the first policy; null where it is not asked for or is the chosen one. */
export function ghostOf(player, state) {
  return state.ghost && state.policy > 0 ? recorded(player.policies[0].episodes[state.episode]) : null;
}

/** The frame that is shown, a whole number. */
export function frameOf(episode, state) {
  return clamp(Math.floor(state.position + 1e-6), 0, episode.frames - 1);
}

export function decimals(dt) {
  return clamp(Math.ceil(-Math.log10(dt) - 1e-9), 1, 3);
}
