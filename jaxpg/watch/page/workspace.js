// The workspace: where the goals of many episodes lay, and which of them were reached.

import { axes, label, tickRoom } from "./axes.js";
import { element, figure, inlineMark, mark, onWidth, shape } from "./dom.js";
import { clamp, text, ticks } from "./numbers.js";
import { ending } from "./player.js";

const LARGEST = 420; // pixels of a picture's sides, or of those of each of several
const LARGEST_OF_SEVERAL = 300;
const GAP = 36; // between two of them, as in the style sheet

export function workspace(data, player, view) {
  const holder = element("div", { class: "workspace" });
  const counts = element("table", { class: "counts" });
  const draw = () => {
    const number = holder.clientWidth > 500 ? data.pictures.length : 1; // side by side
    const width = Math.floor((holder.clientWidth - GAP * (number - 1)) / number);
    if (width > 0) holder.replaceChildren(...data.pictures.map((one) => drawPicture(data, one, view.state, width)));
  };
  const count = () => counts.replaceChildren(...countRows(data, player, view.state));
  onWidth(holder, draw);
  view.listen((changed) => {
    if (changed.has("policy") || changed.has("episode")) draw();
    if (changed.has("policy")) count();
  });
  count();
  const hasDistances = data.pictures[0].points.some((points) => points.some((point) => point[2] !== null));
  const faint = hasDistances && data.success_radius !== null;
  const words = "The fainter a cross, the nearer the goal at the end.";
  return figure(data.title, holder, counts, faint ? element("p", { class: "reading" }, words) : null);
}

/** One look at the goals; a metre is as long in all directions. */
function drawPicture(data, picture, state, width) {
  const marks = [picture.x_range, picture.y_range].map((range) => ticks(range, 5));
  const left = tickRoom(marks[1]);
  const largest = data.pictures.length > 1 ? LARGEST_OF_SEVERAL : LARGEST;
  const [across, upwards] = [picture.x_range, picture.y_range].map(([low, high]) => high - low);
  const unit = Math.min((width - left - 10) / across, largest / across, largest / upwards);
  const box = { left, top: 22, width: unit * across, height: unit * upwards };
  const svg = shape("svg", { width, height: box.height + 66, role: "img", "aria-label": data.title });
  const x = { range: picture.x_range, ticks: marks[0], label: picture.x };
  const { X, Y, inside } = axes(svg, box, x, { range: picture.y_range, ticks: marks[1] });
  svg.append(label(0, 12, "start", picture.y, "title"));
  if (picture.circle) {
    const [cx, cy, radius] = picture.circle;
    inside.append(shape("circle", { class: "limit", cx: X(cx), cy: Y(cy), r: radius * unit }));
  }
  for (const [a, b, distance, success] of [...picture.points[state.policy]].sort((p, q) => q[3] - p[3])) {
    const end = distance === null ? ending({ success: success > 0 }) : `: ${text(distance)} m away at the end`;
    const words = `goal ${text(a)}, ${text(b)}${end}`;
    const point = mark(success > 0, X(a), Y(b), 3.4, shape("title", {}, words));
    if (success <= 0) point.setAttribute("stroke-opacity", strength(distance, data.success_radius));
    inside.append(point);
  }
  const goal = picture.chosen[state.policy]?.[state.episode];
  if (goal) inside.append(shape("circle", { class: "chosen", cx: X(goal[0]), cy: Y(goal[1]), r: 8 }));
  return svg;
}

/** How strong the mark of a goal is that was not reached: full from ten times the radius of success on, faint near. */
function strength(distance, radius) {
  return distance === null || radius === null ? 1 : clamp(0.3 + 0.7 * Math.log10(distance / radius), 0.3, 1);
}

/** How many goals each policy has reached, in words. */
function countRows(data, player, state) {
  const within = data.success_radius === null ? "reached" : `within ${text(data.success_radius)} m`;
  const head = [["goals"], [inlineMark(true), ` ${within}`], [inlineMark(false), " not"]];
  const rows = data.pictures[0].points.map((points, i) => {
    const reached = points.filter((point) => point[3] > 0).length;
    const name = player?.policies[i]?.label ?? `policy ${i + 1}`;
    return [name, `${reached} of ${points.length}`, String(points.length - reached)];
  });
  return [
    element("tr", {}, ...head.map((words, i) => element("th", { scope: "col", class: i ? "number" : null }, ...words))),
    ...rows.map((words, i) => countRow(words, i === state.policy)),
  ];
}

function countRow([name, ...counts], isChosen) {
  const cells = counts.map((words) => element("td", { class: "number" }, words));
  return element("tr", { class: isChosen ? "strong" : null }, element("td", {}, name), ...cells);
}
