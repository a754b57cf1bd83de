// The phase portrait: the value function as a map, and the episode's path over it.

import { axes, fitting, label, linear, linePath, rule, tickRoom } from "./axes.js";
import { contour } from "./contours.js";
import { element, figure, onWidth, shape } from "./dom.js";
import { angleTicks, clamp, extent, fixed, text, ticks, unpack } from "./numbers.js";
import { shadePicture, SHADES } from "./palette.js";
import { chosen, frameOf } from "./rollout.js";

export function portrait(data, player, view) {
  const maps = data.values.map((grid) => mapOf(grid, data));
  const range = extent(maps.map((map) => [map.low, map.high]));
  const holder = element("div", { class: "map" });
  const reading = element("p", { class: "reading" });
  let drawing = null;
  const draw = () => {
    if (holder.clientWidth === 0) return;
    drawing = drawPortrait(holder, data, maps[view.state.policy], range);
    drawing.svg.addEventListener("pointermove", (event) => readMap(reading, drawing, data, event));
    drawing.svg.addEventListener("pointerleave", () => move());
    move();
  };
  const move = () => {
    const episode = player && chosen(player, view.state);
    if (!episode?.path || !drawing) return;
    drawPath(drawing, data, episode.path, view.state.position);
    reading.textContent = episodeReading(data, episode, frameOf(episode, view.state));
  };
  onWidth(holder, draw);
  view.listen((changed) => (changed.has("policy") ? draw() : move()));
  return figure(data.title, holder, reading);
}

/** A grid unpacked: values of all points, and how it is read between them. */
function mapOf(grid, { columns, rows, x, y }) {
  const span = (grid.high - grid.low) / 32767;
  const values = Float64Array.from(unpack(grid.data), (number) => grid.low + number * span);
  const [column, row] = [linear(x.range, [0, columns - 1]), linear(y.range, [0, rows - 1])];
  const value = (px, py) => bilinear(values, columns, rows, column(px), row(py));
  return { ...grid, values, value };
}

/** The value between the four points of the grid around a column and a row. */
function bilinear(values, columns, rows, column, row) {
  const [c, r] = [clamp(Math.floor(column), 0, columns - 2), clamp(Math.floor(row), 0, rows - 2)];
  const [u, v] = [clamp(column - c, 0, 1), clamp(row - r, 0, 1)];
  const at = (right, up) => values[(r + up) * columns + c + right];
  return (1 - v) * ((1 - u) * at(0, 0) + u * at(1, 0)) + v * ((1 - u) * at(0, 1) + u * at(1, 1));
}

function drawPortrait(holder, data, map, range) {
  const width = holder.clientWidth;
  const [xTicks, yTicks] = [axisTicks(data.x, fitting(width)), axisTicks(data.y, 8)];
  const left = tickRoom(yTicks);
  const box = { left, top: 22, width: width - left - 10, height: Math.min(width - left - 10, 420) - 60 };
  const svg = shape("svg", { width, height: box.top + box.height + 92, role: "img" });
  svg.setAttribute("aria-label", `${data.title}: value from ${text(map.low)} to ${text(map.high)}`);
  holder.replaceChildren(svg);
  const drawing = { svg, map, ...axes(svg, box, { ...data.x, ticks: xTicks }, { ...data.y, ticks: yTicks }) };
  svg.append(label(0, 12, "start", data.y.label, "title"));
  holder.prepend(placed(picture(data, map, range, box), box));
  drawContours(drawing, data, map, ticks(range, 6));
  drawBar(holder, svg, { ...box, top: box.top + box.height + 56, height: 10 }, map, range);
  for (const kind of ["path pale-path", "path halo", "path", "here"]) {
    drawing[kind] = drawing.inside.appendChild(shape(kind === "here" ? "circle" : "path", { class: kind, r: 5 }));
  }
  return drawing;
}

function axisTicks(axis, count) {
  const round = axis.wraps && Math.abs(axis.range[1] - axis.range[0] - 2 * Math.PI) < 1e-3 && axis.range[0] < -3;
  return round ? angleTicks() : ticks(axis.range, count);
}

/** The map as a canvas of the box's size; the outermost points of the grid lie on the edges. */
function picture({ columns, rows }, map, [low, high], box) {
  const small = shadePicture(columns, rows, (column, row) => (map.values[row * columns + column] - low) / (high - low));
  const canvas = element("canvas", { width: Math.round(2 * box.width), height: Math.round(2 * box.height) });
  const context = canvas.getContext("2d");
  context.imageSmoothingQuality = "high";
  context.drawImage(small, 0.5, 0.5, columns - 1, rows - 1, 0, 0, canvas.width, canvas.height);
  return canvas;
}

/** A canvas laid under the drawing, at a box. */
function placed(canvas, box) {
  for (const side of ["left", "top", "width", "height"]) canvas.style[side] = `${box[side]}px`;
  return canvas;
}

function drawContours({ inside, X, Y }, { columns, rows, x, y }, map, levels) {
  const [atColumn, atRow] = [linear([0, columns - 1], x.range), linear([0, rows - 1], y.range)];
  for (const { value } of levels) {
    const segments = contour(map.values, columns, rows, value);
    const points = segments.map((ends) => linePath(ends.map(([c, r]) => [X(atColumn(c)), Y(atRow(r))])));
    inside.append(shape("path", { class: "contour", d: points.join("") }));
  }
}

/** The colour bar, of all policies; a bracket shows the range of the chosen one's map. */
function drawBar(holder, svg, box, map, range) {
  const X = linear(range, [box.left, box.left + box.width]);
  holder.prepend(placed(shadePicture(SHADES, 1, (column) => column / (SHADES - 1)), box));
  svg.append(shape("path", { class: "bracket", d: `M${X(map.low)} ${box.top - 2}v-4H${X(map.high)}v4` }));
  for (const one of ticks(range, fitting(box.width))) {
    svg.append(rule(X(one.value), box.top + 10, X(one.value), box.top + 14, "tick"));
    svg.append(label(X(one.value), box.top + 26, "middle", one.text));
  }
  svg.append(label(box.left, box.top - 11, "start", "value", "title"));
}

function drawPath(drawing, data, path, position) {
  const points = path[0].map((x, i) => [x, path[1][i]]);
  const [frame, here] = [Math.floor(position), pointAt(points, position, data)];
  const past = wrappedPath([...points.slice(0, frame + 1), here], drawing, data);
  drawing["path pale-path"].setAttribute("d", wrappedPath(points, drawing, data));
  drawing["path halo"].setAttribute("d", past);
  drawing.path.setAttribute("d", past);
  drawing.here.setAttribute("cx", drawing.X(here[0]));
  drawing.here.setAttribute("cy", drawing.Y(here[1]));
}

/** How far an axis that wraps has to be turned so that b is near a. */
function turnOf(axis, a, b) {
  const period = axis.range[1] - axis.range[0];
  return axis.wraps ? -period * Math.round((b - a) / period) : 0;
}

function pointAt(points, position, { x, y }) {
  const frame = clamp(Math.floor(position), 0, points.length - 1);
  const [a, b] = [points[frame], points[Math.min(frame + 1, points.length - 1)]];
  const share = clamp(position - frame, 0, 1);
  return [x, y].map((axis, i) => wrapped(axis, a[i] + share * (b[i] + turnOf(axis, a[i], b[i]) - a[i])));
}

function wrapped(axis, value) {
  const [low, high] = axis.range;
  return axis.wraps ? low + ((((value - low) % (high - low)) + (high - low)) % (high - low)) : value;
}

/** A line through points that leaves the picture where an axis wraps, and comes in at the other side. */
function wrappedPath(points, { X, Y }, { x, y }) {
  const place = ([px, py]) => `${X(px).toFixed(1)} ${Y(py).toFixed(1)}`;
  let path = `M${place(points[0])}`;
  for (let i = 1; i < points.length; i++) {
    const [a, b] = [points[i - 1], points[i]];
    const [tx, ty] = [turnOf(x, a[0], b[0]), turnOf(y, a[1], b[1])];
    if (tx || ty) path += `L${place([b[0] + tx, b[1] + ty])}M${place([a[0] - tx, a[1] - ty])}`;
    path += `L${place(b)}`;
  }
  return path;
}

function readMap(reading, drawing, data, event) {
  const corner = drawing.svg.getBoundingClientRect();
  const point = [drawing.X.back(event.clientX - corner.left), drawing.Y.back(event.clientY - corner.top)];
  const inside = [data.x, data.y].every(({ range }, i) => point[i] >= range[0] && point[i] <= range[1]);
  if (inside) reading.textContent = pointReading(drawing, data, point);
}

function pointReading({ map }, data, point) {
  return inWords(data, point, map.value(...point));
}

/** Where the episode is at a frame, and the critic's value there: the same as over time, not that of the map. */
function episodeReading(data, { path, series }, frame) {
  return inWords(data, [path[0][frame], path[1][frame]], series.value[frame] ?? null);
}

function inWords({ x, y }, [px, py], value) {
  const name = (axis, number) => `${axis.label.split(" [")[0]} ${fixed(number, 2)}`;
  return `${name(x, px)}, ${name(y, py)}` + (value === null ? "" : `: value ${fixed(value, 2)}`);
}
