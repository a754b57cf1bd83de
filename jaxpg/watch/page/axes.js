// Axes of a figure: scales, grid, ticks and labels.

import { shape } from "./dom.js";

export const FONT = 12; // pixels; as in the style sheet
const DIGIT = 7.6; // width of a character of a tick's text, about

/** x -> pixels, and back by .back(pixels). */
export function linear([low, high], [from, to]) {
  const scale = (value) => from + ((value - low) / (high - low)) * (to - from);
  scale.back = (pixels) => low + ((pixels - from) / (to - from)) * (high - low);
  return scale;
}

/** The room that ticks of a vertical axis need to the left of it. */
export function tickRoom(marks) {
  return Math.ceil(Math.max(...marks.map((one) => one.text.length)) * DIGIT) + 8;
}

/** How many ticks fit into a width. */
export function fitting(width) {
  return Math.max(2, Math.floor(width / 75));
}

/**
 * Draws the axes of a box {left, top, width, height} into an SVG element.
 * x and y are {range, ticks, label}; a label of null leaves out the axis' texts as well.
 * Returns the scales {X, Y} and `inside`, a group that is clipped to the box.
 */
export function axes(svg, box, x, y) {
  const X = linear(x.range, [box.left, box.left + box.width]);
  const Y = linear(y.range, [box.top + box.height, box.top]);
  const bottom = box.top + box.height;
  const grid = shape("g", { class: "grid" });
  for (const { value } of y.ticks) grid.append(rule(box.left, Y(value), box.left + box.width, Y(value)));
  for (const { value } of x.ticks) grid.append(rule(X(value), box.top, X(value), bottom));
  const inside = shape("g", { "clip-path": `url(#${clip(svg, box)})` });
  svg.append(grid, shape("path", { class: "axis", d: `M${box.left} ${bottom}h${box.width}` }), inside);
  for (const one of y.ticks) svg.append(label(box.left - 7, Y(one.value) + FONT / 3, "end", one.text));
  if (x.label !== null) {
    for (const one of x.ticks) svg.append(label(X(one.value), bottom + 17, "middle", one.text));
    svg.append(label(box.left + box.width, bottom + 34, "end", x.label));
  }
  return { X, Y, inside };
}

let clips = 0;

/** Something to clip with, in this element; its id. */
function clip(svg, box) {
  const id = `clip${++clips}`;
  const { left: x, top: y, width, height } = box;
  svg.append(shape("clipPath", { id }, shape("rect", { x, y, width, height })));
  return id;
}

export function rule(x1, y1, x2, y2, kind = null) {
  return shape("line", { x1, y1, x2, y2, class: kind });
}

export function label(x, y, anchor, words, kind = null) {
  return shape("text", { x, y, "text-anchor": anchor, class: kind }, words);
}

/** The path of a line through points; a gap where a coordinate is null. */
export function linePath(points) {
  let down = false;
  let path = "";
  for (const [x, y] of points) {
    const gap = x === null || y === null;
    if (!gap) path += `${down ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`;
    down = !gap;
  }
  return path;
}

/** y of a scale, or null where there is no value. */
export function at(scale, value) {
  return value === null || value === undefined ? null : scale(value);
}
