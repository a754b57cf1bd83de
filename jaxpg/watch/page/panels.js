// What happens over time: a panel for each series, with a cursor at the player's time.

import { at, axes, fitting, label, linePath, rule, tickRoom } from "./axes.js";
import { element, onWidth, shape } from "./dom.js";
import { clamp, extent, fixed, ticks } from "./numbers.js";
import { goTo } from "./player.js";
import { chosen, frameOf, ghostOf } from "./rollout.js";

const PANEL_GAP = 34; // above each, for its title

export function panels(player, view) {
  const holder = element("figure", { class: "panels" }, element("h3", {}, "over time"));
  let drawing = null;
  const draw = () => {
    const width = holder.clientWidth;
    if (width === 0) return;
    drawing?.svg.remove();
    drawing = drawPanels(player, view.state, width);
    holder.append(drawing.svg);
    scrubbing(drawing, player, view);
    drawing.move(view.state);
  };
  onWidth(holder, draw);
  view.listen((changed) => {
    if (changed.has("policy") || changed.has("episode") || changed.has("ghost")) draw();
    else drawing?.move(view.state);
  });
  return holder;
}

/** Least and greatest of a series over all policies and episodes, so that they can be compared. */
function seriesRange(player, name) {
  const all = player.policies.flatMap((policy) => policy.episodes.map((one) => one.series[name] ?? []));
  const limit = limitNamed(player, name);
  return extent(limit ? [...all, [-limit, limit]] : all, 0.1);
}

function limitNamed(player, name) {
  return player.limits[name] ?? null;
}

function drawPanels(player, state, width) {
  const count = player.series.length;
  const height = clamp((width + 20) / count - PANEL_GAP, 56, 110);
  const ranges = player.series.map((name) => seriesRange(player, name));
  const marks = ranges.map((range) => ticks(range, 3));
  const left = Math.max(...marks.map(tickRoom));
  const seconds = Math.max(...player.policies.flatMap((p) => p.episodes.map((e) => e.frames - 1))) * player.dt;
  const svg = shape("svg", { width, height: count * (height + PANEL_GAP) + 38, role: "img", class: "scrubbed" });
  svg.setAttribute("aria-label", `over time: ${player.series.join(", ")}`);
  const drawn = player.series.map((name, i) => {
    const box = { left, top: i * (height + PANEL_GAP) + PANEL_GAP - 8, width: width - left - 8, height };
    const timeAxis = { range: [0, seconds], ticks: ticks([0, seconds], fitting(box.width)), label: null };
    if (i === count - 1) timeAxis.label = "time [s]";
    return drawPanel(svg, box, timeAxis, { range: ranges[i], ticks: marks[i] }, player, state, name);
  });
  return { svg, X: drawn[0].X, move: (now) => moveCursor(drawn, player, now) };
}

function drawPanel(svg, box, x, y, player, state, name) {
  const { X, Y, inside } = axes(svg, box, x, y);
  const limit = limitNamed(player, name);
  const right = box.left + box.width;
  if (limit) inside.append(...[-limit, limit].map((value) => rule(box.left, Y(value), right, Y(value), "limit")));
  const steps = !["reward", "value"].includes(name); // commands are held from one frame to the next
  const ghost = ghostOf(player, state);
  const line = (episode, kind) =>
    shape("path", { class: kind, d: overTime(episode.series[name], player.dt, X, Y, steps) });
  if (ghost) inside.append(line(ghost, "line pale"));
  inside.append(line(chosen(player, state), "line"));
  svg.append(label(0, box.top - 8, "start", name, "title"));
  const reading = svg.appendChild(label(right, box.top - 8, "end", "", "title strong"));
  const cursor = svg.appendChild(rule(0, box.top, 0, box.top + box.height, "cursor"));
  const dot = svg.appendChild(shape("circle", { r: 3.5, class: "dot" }));
  return { X, Y, name, reading, cursor, dot };
}

function overTime(values, dt, X, Y, steps) {
  const points = (values ?? []).map((value, i) => [X(i * dt), at(Y, value)]);
  return linePath(steps ? points.flatMap(([x, y], i) => [[x, y], [X((i + 1) * dt), y]]) : points);
}

function moveCursor(drawn, player, state) {
  const episode = chosen(player, state);
  const frame = frameOf(episode, state);
  const x = drawn[0].X(clamp(state.position, 0, episode.frames - 1) * player.dt);
  for (const { X, Y, name, reading, cursor, dot } of drawn) {
    for (const end of ["x1", "x2"]) cursor.setAttribute(end, x);
    const value = episode.series[name]?.[frame] ?? null;
    reading.textContent = fixed(value, 2);
    dot.setAttribute("visibility", value === null ? "hidden" : "visible");
    dot.setAttribute("cx", X(frame * player.dt));
    dot.setAttribute("cy", value === null ? 0 : Y(value));
  }
}

/** Pressing or dragging in the panels goes to that time. */
function scrubbing({ svg, X }, player, view) {
  const go = (event) => goTo(player, view, X.back(event.clientX - svg.getBoundingClientRect().left) / player.dt);
  svg.addEventListener("pointerdown", (event) => {
    svg.setPointerCapture(event.pointerId);
    go(event);
  });
  svg.addEventListener("pointermove", (event) => svg.hasPointerCapture(event.pointerId) && go(event));
}
