// The player: choice of policy and episode, the stage, and the bar below it.

import { element, inlineMark, onWidth, shape } from "./dom.js";
import { clamp, fixed, text } from "./numbers.js";
import { chosen, decimals, frameOf } from "./rollout.js";
import { paintSpace } from "./space.js";
import { paintStage } from "./stage.js";
import { onTheme } from "./theme.js";
import { startTurning } from "./turning.js";

const SPEEDS = [0.25, 0.5, 1, 2, 4];

/** The choices above the linked views. */
export function choices(player, view) {
  const policies = radios("policy", player.policies.map(policyName), view, "policy");
  const episodes = radios("episode", player.policies[0].episodes.map((_, i) => [String(i + 1)]), view, "episode");
  const box = element("input", { type: "checkbox", id: "ghost" });
  const ghost = element("label", { class: "ghost" }, box, `ghost: ${player.policies[0].label}`);
  box.addEventListener("change", () => view.set({ ghost: box.checked }));
  const refresh = () => {
    box.disabled = view.state.policy === 0;
    markEpisodes(episodes, player.policies[view.state.policy].episodes);
  };
  view.listen((changed) => changed.has("policy") && refresh());
  refresh();
  return element("div", { class: "choices" }, policies, episodes, player.policies.length > 1 ? ghost : null);
}

function policyName({ label, note }) {
  return [label, note ? element("small", {}, note) : ""];
}

/** A row of radio buttons for a number of the state. */
function radios(title, names, view, field) {
  const group = element("fieldset", { class: "radios", id: field }, element("legend", {}, title));
  names.forEach((words, i) => {
    const input = element("input", { type: "radio", name: field, value: i, checked: i === view.state[field] });
    input.addEventListener("change", () => view.set({ [field]: i }));
    group.append(element("label", {}, input, element("span", {}, ...words)));
  });
  group.addEventListener("click", (event) => event.detail > 0 && document.getElementById("stage").focus());
  view.listen((changed) => {
    if (changed.has(field)) group.querySelectorAll("input")[view.state[field]].checked = true;
  });
  return group;
}

/** Says beside each episode's number how it ends with this policy. */
function markEpisodes(group, episodes) {
  group.querySelectorAll("label").forEach((label, i) => {
    const episode = episodes[i];
    label.querySelector("svg")?.remove();
    if (episode.success !== null) label.lastChild.append(inlineMark(episode.success));
    label.title = `return ${text(episode.return)}${ending(episode)}`;
    label.firstChild.setAttribute("aria-label", `episode ${i + 1}, ${label.title}`);
  });
}

export function ending(episode) {
  if (episode.success === null) return "";
  return episode.success ? ", success" : ", no success";
}

/** The stage with its bar; starts the clock. */
export function stage(player, view) {
  const label = { role: "img", "aria-label": "drawing of the rollout" };
  const canvas = element("canvas", { id: "stage", class: player.space ? "turned" : null, tabindex: 0, ...label });
  const reading = element("p", { class: "reading", id: "so-far" });
  const turning = player.space && startTurning(canvas, player.space, () => paint());
  const paint = () => {
    if (turning) paintSpace(canvas, player, view.state, turning.view);
    else paintStage(canvas, player, view.state);
    reading.replaceChildren(...returnReading(chosen(player, view.state), view.state));
  };
  const figure = element("figure", { class: "stage" }, canvas, bar(player, view), reading);
  canvas.addEventListener("click", () => turning?.wasDragged() || toggle(player, view));
  canvas.addEventListener("turn", () => turning?.next());
  onWidth(figure, (width) => {
    canvas.style.height = `${Math.round(clamp(width * shapeOf(player), 160, player.space ? 540 : 460))}px`;
    paint();
  });
  addEventListener("resize", paint); // also when the page is zoomed, or taken to a finer screen
  onTheme(paint);
  view.listen(paint);
  startClock(player, view);
  return figure;
}

/** Height of the stage for a width of 1. */
function shapeOf({ space, view }) {
  if (space) return 0.8;
  const [left, low, right, high] = view;
  return (high - low) / (right - left);
}

function returnReading(episode, state) {
  const total = element("b", {}, fixed(episode.return, 1));
  if (!episode.soFar) return ["return ", total, ending(episode)];
  const soFar = element("b", {}, fixed(episode.soFar[frameOf(episode, state)], 1));
  return ["return so far ", soFar, " of ", total, ending(episode)];
}

/** Play, scrub, time, speed. */
function bar(player, view) {
  const play = element("button", { type: "button", id: "play" }, playIcon());
  const scrub = element("input", { type: "range", id: "scrub", min: 0, step: 1, "aria-label": "time" });
  const time = element("output", { id: "time", for: "scrub" });
  const options = SPEEDS.map((x) => element("option", { value: x, selected: x === 1 }, `${x}×`));
  const speed = element("select", { id: "speed", "aria-label": "speed" }, ...options);
  play.addEventListener("click", () => toggle(player, view));
  scrub.addEventListener("input", () => goTo(player, view, Number(scrub.value)));
  speed.addEventListener("change", () => view.set({ speed: Number(speed.value) }));
  const refresh = () => {
    const episode = chosen(player, view.state);
    const frame = frameOf(episode, view.state);
    const digits = decimals(player.dt);
    scrub.max = episode.frames - 1;
    scrub.value = frame;
    time.textContent = `${fixed(frame * player.dt, digits)} / ${fixed((episode.frames - 1) * player.dt, digits)} s`;
    scrub.setAttribute("aria-valuetext", `${fixed(frame * player.dt, digits)} seconds`);
    play.setAttribute("aria-label", view.state.playing ? "pause" : "play");
    play.dataset.playing = view.state.playing;
  };
  view.listen(refresh);
  refresh();
  return element("div", { class: "bar" }, play, scrub, time, speed);
}

function playIcon() {
  return shape(
    "svg",
    { width: 14, height: 14, viewBox: "0 0 14 14", "aria-hidden": "true" },
    shape("path", { class: "when-paused", d: "M2.5 1v12l10-6z" }),
    shape("path", { class: "when-playing", d: "M2 1h3.5v12H2zM8.5 1H12v12H8.5z" }),
  );
}

/** Shows a frame, at rest. */
export function goTo(player, view, frame) {
  view.set({ playing: false, position: clamp(Math.round(frame), 0, chosen(player, view.state).frames - 1) });
}

/** Plays or pauses; from the beginning if it is at the end. */
export function toggle(player, view) {
  const episode = chosen(player, view.state);
  const frame = frameOf(episode, view.state);
  if (view.state.playing) view.set({ playing: false, position: frame });
  else view.set({ playing: true, position: frame >= episode.frames - 1 ? 0 : frame });
}

/** Moves the position on, by the clock on the wall, while it plays; another episode may be shorter. */
function startClock(player, view) {
  let [before, request] = [0, 0];
  const tick = (now) => {
    const seconds = clamp((now - before) / 1000, 0, 0.1); // a page that was hidden goes on where it was
    const last = chosen(player, view.state).frames - 1;
    const position = Math.min(view.state.position + (seconds * view.state.speed) / player.dt, last);
    before = now;
    view.set({ position, playing: position < last });
    if (position < last) request = requestAnimationFrame(tick);
  };
  view.listen((changed) => {
    const last = chosen(player, view.state).frames - 1;
    if (view.state.position > last) view.set({ position: last });
    if (!changed.has("playing")) return;
    cancelAnimationFrame(request);
    before = performance.now();
    if (view.state.playing) request = requestAnimationFrame(tick);
  });
}
