// Learning curves with intervals; pointing at them, or the arrow keys, read values.

import { at, axes, fitting, FONT, label, linePath, rule, tickRoom } from "./axes.js";
import { element, figure, onWidth, shape } from "./dom.js";
import { clamp, extent, text, ticks } from "./numbers.js";
import { seriesClass } from "./palette.js";

export function curves(panel, numberOf) {
  const steps = [...new Set(panel.series.flatMap((one) => one.steps))].sort((a, b) => a - b);
  const holder = element("div", { class: "curve", tabindex: 0, role: "slider" });
  holder.setAttribute("aria-label", `${panel.title}: read values`);
  const legend = element("ul", { class: "legend" }, ...panel.series.map((one) => legendItem(one, numberOf)));
  const where = element("p", { class: "reading" });
  const state = { index: steps.length - 1, drawing: null };
  const read = (index) => {
    state.index = clamp(index, 0, steps.length - 1);
    showValues(holder, legend, where, panel, steps, state);
  };
  onWidth(holder, (width) => {
    state.drawing = drawCurves(panel, steps, numberOf, width);
    holder.replaceChildren(state.drawing.svg);
    read(state.index);
  });
  holder.addEventListener("pointermove", (event) => {
    const x = event.clientX - holder.getBoundingClientRect().left;
    if (state.drawing) read(nearest(steps, state.drawing.X.back(x)));
  });
  holder.addEventListener("pointerleave", () => read(steps.length - 1));
  holder.addEventListener("keydown", (event) => readByKey(event, state, steps, read));
  return figure(panel.title, legend, holder, where, referencesInWords(panel));
}

/** Those that lie outside of the picture. */
function referencesInWords(panel) {
  const [low, high] = valueRange(panel);
  const outside = (panel.references ?? []).filter(({ value }) => value < low || value > high);
  if (!outside.length) return null;
  const words = outside.map(({ label, value }) => `${label} ${text(value)}`).join(", ");
  return element("p", { class: "reading" }, `outside the picture: ${words}`);
}

function legendItem({ label, band }, numberOf) {
  const sample = shape("svg", { width: 22, height: 10, "aria-hidden": "true" });
  sample.append(shape("path", { class: `line ${seriesClass(numberOf(label))}`, d: "M1 5h20" }));
  const spread = band ? element("small", {}, band) : null;
  return element("li", {}, sample, element("span", {}, label), element("b", {}), spread);
}

function drawCurves(panel, steps, numberOf, width) {
  const y = { range: valueRange(panel) };
  const x = { range: [Math.min(0, steps[0] ?? 0), steps.at(-1) || 1], label: panel.x };
  y.ticks = ticks(y.range, 6);
  const left = tickRoom(y.ticks);
  const box = { left, top: 8, width: width - left - 22, height: clamp(0.55 * width, 180, 300) };
  x.ticks = ticks(x.range, fitting(box.width));
  const svg = shape("svg", { width, height: box.top + box.height + 40, "aria-hidden": "true" });
  const { X, Y, inside } = axes(svg, box, x, y);
  for (const one of panel.series) drawCurve(inside, one, X, Y, seriesClass(numberOf(one.label)));
  drawReferences(svg, box, Y, y.range, panel.references ?? []);
  const cursor = svg.appendChild(rule(0, box.top, 0, box.top + box.height, "cursor"));
  const dots = panel.series.map(({ label }) =>
    svg.appendChild(shape("circle", { r: 3.5, class: `dot ${seriesClass(numberOf(label))}` })),
  );
  return { svg, X, Y, cursor, dots };
}

/** The range of the curves, with those references in it that do not make them smaller than half of the picture. */
function valueRange({ series, references }) {
  let [low, high] = extent(series.flatMap((one) => [one.mean, one.low ?? [], one.high ?? []]), 0.08);
  const room = 0.06 * (high - low);
  for (const { value } of references ?? []) {
    const wider = [Math.min(low, value - room), Math.max(high, value + 2 * room)];
    if (wider[1] - wider[0] <= 2 * (high - low)) [low, high] = wider;
  }
  return [low, high];
}

/** Lines to compare with, each with its name above it; or below, where another name is. */
function drawReferences(svg, box, Y, [low, high], references) {
  const right = box.left + box.width;
  const seen = references.filter(({ value }) => value >= low && value <= high).sort((a, b) => b.value - a.value);
  let before = -Infinity;
  for (const { label: name, value } of seen) {
    const above = Y(value) - 5;
    const y = above - before < FONT + 2 ? Y(value) + FONT + 2 : above;
    svg.append(rule(box.left, Y(value), right, Y(value), "reference"));
    svg.append(label(right, y, "end", `${name} ${text(value)}`, "halo"));
    before = y;
  }
}

function drawCurve(inside, one, X, Y, kind) {
  const line = (values) => one.steps.map((step, i) => [X(step), at(Y, values[i])]);
  if (one.low && one.high) {
    const known = one.steps.map((_, i) => i).filter((i) => one.low[i] !== null && one.high[i] !== null);
    const edge = (values) => known.map((i) => [X(one.steps[i]), Y(values[i])]);
    const around = [...edge(one.high), ...edge(one.low).reverse()];
    if (around.length) inside.append(shape("path", { class: `band ${kind}`, d: `${linePath(around)}Z` }));
  }
  inside.append(shape("path", { class: `line ${kind}`, d: linePath(line(one.mean)) }));
}

/** Puts the cursor to a step, and the values there beside the names. */
function showValues(holder, legend, where, panel, steps, { index, drawing }) {
  if (!drawing || !steps.length) return;
  const step = steps[index];
  const words = panel.series.map((one, i) => {
    const near = nearest(one.steps, step);
    const value = one.mean[near] ?? null;
    const interval = one.low && one.high ? ` (${text(one.low[near])} to ${text(one.high[near])})` : "";
    legend.children[i].querySelector("b").textContent = text(value) + interval;
    showDot(drawing, drawing.dots[i], one.steps[near], value);
    return `${one.label} ${text(value)}${interval}`;
  });
  for (const end of ["x1", "x2"]) drawing.cursor.setAttribute(end, drawing.X(step));
  where.textContent = `at ${Math.round(step).toLocaleString("en")} ${panel.x}`;
  const spoken = `${where.textContent}: ${words.join("; ")}`;
  const slider = { valuemin: 0, valuemax: steps.length - 1, valuenow: index, valuetext: spoken };
  for (const [name, value] of Object.entries(slider)) holder.setAttribute(`aria-${name}`, value);
}

function showDot({ X, Y }, dot, step, value) {
  dot.setAttribute("visibility", value === null ? "hidden" : "visible");
  if (value === null) return;
  dot.setAttribute("cx", X(step));
  dot.setAttribute("cy", Y(value));
}

/** Index of the sorted value that is nearest. */
function nearest(sorted, wanted) {
  let best = 0;
  sorted.forEach((value, i) => {
    if (Math.abs(value - wanted) < Math.abs(sorted[best] - wanted)) best = i;
  });
  return best;
}

function readByKey(event, state, steps, read) {
  const by = event.shiftKey ? 10 : 1;
  const targets = { ArrowLeft: state.index - by, ArrowRight: state.index + by, Home: 0, End: steps.length - 1 };
  if (!(event.key in targets)) return;
  event.preventDefault();
  read(targets[event.key]);
}
