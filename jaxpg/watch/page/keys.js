// The keyboard. Keys go to the player while it can be seen and nothing else that has the focus needs them.

import { element } from "./dom.js";
import { goTo, toggle } from "./player.js";
import { chosen, frameOf } from "./rollout.js";

const KEYS_IN_WORDS = [
  [["Space"], "play, pause"],
  [["←", "→"], "a frame"],
  [["Shift"], "with them: ten frames"],
  [["Home", "End"], "first, last frame"],
  [["[", "]"], "episode"],
  [["P"], "policy"],
];

/** The short line that says them. */
export function keysLine(player) {
  const words = [...KEYS_IN_WORDS, ...(player.space ? [[["V"], "view"], [["drag"], "turn"]] : [])];
  const parts = words.map(([keys, meaning]) =>
    element("span", {}, ...keys.map((key) => element("kbd", {}, key)), ` ${meaning}`),
  );
  return element("p", { class: "keys" }, ...parts);
}

export function startKeys(player, view) {
  const actions = keyActions(player, view);
  document.addEventListener("keydown", (event) => {
    const typed = event.getModifierState("AltGraph"); // brackets need it on some keyboards
    if (event.defaultPrevented || ((event.ctrlKey || event.altKey || event.metaKey) && !typed)) return;
    const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action || isTaken(event.target, event.key) || !isSeen(document.getElementById("stage"))) return;
    event.preventDefault();
    action(event.shiftKey ? 10 : 1);
  });
}

function keyActions(player, view) {
  const frame = () => frameOf(chosen(player, view.state), view.state);
  const turn = (field, by, number) => view.set({ [field]: (view.state[field] + by + number) % number });
  const episodes = player.policies[0].episodes.length;
  return {
    " ": () => toggle(player, view),
    ArrowLeft: (frames) => goTo(player, view, frame() - frames),
    ArrowRight: (frames) => goTo(player, view, frame() + frames),
    Home: () => goTo(player, view, 0),
    End: () => goTo(player, view, Infinity),
    "[": () => turn("episode", -1, episodes),
    "]": () => turn("episode", 1, episodes),
    p: () => turn("policy", 1, player.policies.length),
    v: () => document.getElementById("stage").dispatchEvent(new Event("turn")),
  };
}

/** Whether the element with the focus does something of its own with a key. */
function isTaken(target, key) {
  if (target.matches("select, [role=slider], [role=region]")) return true;
  if (target.matches("button, summary, [type=checkbox]")) return key === " ";
  return target.matches("[type=radio]") && key.startsWith("Arrow");
}

function isSeen(node) {
  const { top, bottom } = node.getBoundingClientRect();
  return bottom > 0 && top < innerHeight;
}
