// The workspace: where the goals of many episodes lay, and which of them were reached.

import { axes, label, tickRoom } from "./axes.js";
import { element, figure, inlineMark, mark, onWidth, shape } from "./dom.js";
import { text, ticks } from "./numbers.js";
import { ending } from "./player.js";

export function workspace(data, player, view) {
  const holder = element("div", { class: "workspace" });
  const counts = element("table", { class: "counts" });
  const draw = () => {
    const width = holder.clientWidth;
    if (width) holder.replaceChildren(drawWorkspace(data, player, view.state, width));
  };
  const count = () => counts.replaceChildren(...countRows(data, player, view.state));
  onWidth(holder, draw);
  view.listen((changed) => {
    if (changed.has("policy") || changed.has("episode")) draw();
    if (changed.has("policy")) count();
  });
  count();
  return figure(data.title, holder, counts);
}

function drawWorkspace(data, player, state, width) {
  const points = data.points[state.policy];
  const reach = Math.max(data.radius, ...points.map(([x, y]) => Math.hypot(x, y))) * 1.08;
  const marks = ticks([-reach, reach], 5);
  const left = tickRoom(marks);
  const side = Math.min(width - left - 10, 420);
  const svg = shape("svg", { width, height: side + 66, role: "img", "aria-label": data.title });
  const axis = { range: [-reach, reach], ticks: marks };
  const { X, Y, inside } = axes(svg, { left, top: 22, width: side, height: side }, { ...axis, label: data.x }, axis);
  svg.append(label(0, 12, "start", data.y, "title"));
  inside.append(shape("circle", { class: "limit", cx: X(0), cy: Y(0), r: X(data.radius) - X(0) }));
  for (const [x, y, distance, success] of [...points].sort((a, b) => b[3] - a[3])) {
    const end = distance === null ? ending({ success: success > 0 }) : `: ${text(distance)} m away at the end`;
    const words = `goal ${text(x)}, ${text(y)}${end}`;
    inside.append(mark(success > 0, X(x), Y(y), 3.4, shape("title", {}, words)));
  }
  const goal = player && player.policies[state.policy].episodes[state.episode].goal;
  if (goal) inside.append(shape("circle", { class: "chosen", cx: X(goal[0]), cy: Y(goal[1]), r: 8 }));
  return svg;
}

/** How many goals each policy has reached, in words. */
function countRows(data, player, state) {
  const within = data.success_radius === null ? "reached" : `within ${text(data.success_radius)} m`;
  const head = [["goals"], [inlineMark(true), ` ${within}`], [inlineMark(false), " not"]];
  const rows = data.points.map((points, i) => {
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
