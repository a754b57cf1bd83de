// The drawing of a rollout: the robot's parts, the goal, and the motors' torques as arcs.

import { FONT } from "./axes.js";
import { clamp, extent, niceStep } from "./numbers.js";
import { hull, pointsSeen } from "./outline.js";
import { chosen, frameOf, ghostOf } from "./rollout.js";
import { colour } from "./theme.js";

/** Paints the chosen episode, and the ghost behind it, at the state's position. */
export function paintStage(canvas, player, state) {
  const context = sharp(canvas);
  const place = placing(canvas, player.view);
  const episode = chosen(player, state);
  const ghost = ghostOf(player, state);
  paintSquares(context, canvas, place, player.view);
  if (episode.goal) paintGoal(context, place, player, episode);
  const dials = dialsOf(context, place, player, episode, state.position);
  paintDials(context, dials);
  if (ghost) paintParts(context, place, player, ghost, state.position, () => colour("ghost"));
  paintParts(context, place, player, episode, state.position, (part) => part.color);
  paintTorques(context, dials, player, episode, frameOf(episode, state));
}

/** A cleared canvas in units of CSS pixels, as fine as the screen. */
export function sharp(canvas) {
  const ratio = devicePixelRatio || 1;
  const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
  return context;
}

/** Metres -> pixels: the view as large as it fits, in the middle. */
function placing(canvas, [left, low, right, high]) {
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const unit = Math.min(width / (right - left), height / (high - low));
  const x = (metres) => width / 2 + (metres - (left + right) / 2) * unit;
  const y = (metres) => height / 2 - (metres - (low + high) / 2) * unit;
  return { x, y, unit };
}

/** A faint grid, and a bar that says how long its meshes are. */
function paintSquares(context, canvas, place, [left, low, right, high]) {
  const mesh = niceStep(Math.max(right - left, high - low), 8);
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  context.strokeStyle = colour("grid");
  context.lineWidth = 1;
  context.beginPath();
  for (let x = place.x(0) % (mesh * place.unit); x < width; x += mesh * place.unit) line(context, x, 0, x, height);
  for (let y = place.y(0) % (mesh * place.unit); y < height; y += mesh * place.unit) line(context, 0, y, width, y);
  context.stroke();
  context.strokeStyle = context.fillStyle = colour("muted");
  context.lineWidth = 2;
  context.beginPath();
  line(context, 14, height - 14, 14 + mesh * place.unit, height - 14);
  context.stroke();
  context.font = `${FONT}px ${getComputedStyle(canvas).fontFamily}`;
  context.fillText(`${Number(mesh.toPrecision(1))} m`, 14, height - 21);
}

function line(context, x1, y1, x2, y2) {
  context.moveTo(x1, y1);
  context.lineTo(x2, y2);
}

/** A ring as wide as the goal; filled where the episode ends in success. */
function paintGoal(context, place, player, episode) {
  const [x, y] = episode.goal;
  const radius = Math.max(5, (player.goal_radius ?? 0) * place.unit);
  context.beginPath();
  context.arc(place.x(x), place.y(y), radius, 0, 2 * Math.PI);
  context.strokeStyle = colour("success");
  context.fillStyle = colour("success-pale");
  context.lineWidth = 2;
  if (episode.success) context.fill();
  context.stroke();
}

/** Numbers of a frame, between two of them where the position is: `count` numbers from `first` on. */
function between(numbers, size, episode, position, first, count) {
  const frame = clamp(Math.floor(position), 0, episode.frames - 1);
  const next = Math.min(frame + 1, episode.frames - 1);
  const share = clamp(position - frame, 0, 1);
  return Array.from({ length: count }, (_, i) => {
    const [from, to] = [numbers[frame * size + first + i], numbers[next * size + first + i]];
    return (from + (to - from) * share) * episode.scale;
  });
}

const PART_NUMBERS = 8; // of a part in a frame: its place, and what is seen of the axes of its frame

/** Every part as the hull of its points with its rim, the farthest first. */
function paintParts(context, place, player, episode, position, colourOf) {
  context.lineCap = context.lineJoin = "round";
  player.parts.forEach((part, i) => {
    const size = PART_NUMBERS * player.parts.length;
    const numbers = between(episode.parts, size, episode, position, PART_NUMBERS * i, PART_NUMBERS);
    const outline = hull(pointsSeen(part, numbers).map(([x, y]) => [place.x(x), place.y(y)]));
    const rim = Math.max(outline.length > 2 ? 1 : 3, 2 * part.radius * place.unit);
    for (const [extra, style] of [[3, colour("raised")], [0, colourOf(part)]]) {
      context.lineWidth = rim + extra;
      context.strokeStyle = context.fillStyle = style;
      tracePolygon(context, outline);
      context.stroke();
      context.fill();
    }
  });
}

function tracePolygon(context, corners) {
  context.beginPath();
  corners.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
  if (corners.length === 1) context.lineTo(corners[0][0] + 0.01, corners[0][1]);
  context.closePath();
}

/** Where the motors are at the position, in pixels, and how large their dials are. */
function dialsOf(context, place, player, episode, position) {
  const size = clamp(0.09 * Math.min(context.canvas.clientWidth, context.canvas.clientHeight), 18, 40);
  return player.motors.map((motor, i) => {
    const [x, y] = between(episode.motors, 2 * player.motors.length, episode, position, 2 * i, 2);
    return [place.x(x), place.y(y), size];
  });
}

function paintDials(context, dials) {
  context.lineWidth = 1;
  context.strokeStyle = colour("rule");
  for (const [x, y, size] of dials) {
    context.beginPath();
    context.arc(x, y, size, 0, 2 * Math.PI);
    context.stroke();
  }
}

/** Torques as arcs: three quarters of a turn at the motor's limit. */
function paintTorques(context, dials, player, episode, frame) {
  player.motors.forEach((motor, i) => {
    const torque = episode.series[motor.name]?.[frame] ?? 0;
    const turn = (clamp(torque / limitOf(player, motor), -1, 1) * (motor.sign ?? 1) * 3 * Math.PI) / 2;
    paintArc(context, ...dials[i], turn);
  });
}

/** The motor's limit; where it has none, the greatest torque of the episodes. */
function limitOf(player, motor) {
  if (motor.limit) return motor.limit;
  const all = player.policies.flatMap((policy) => policy.episodes.map((one) => one.series[motor.name] ?? []));
  return Math.max(...extent(all).map(Math.abs)) || 1;
}

/** An arc from the top, counter-clockwise where the turn is positive, with an arrow head at its end. */
function paintArc(context, x, y, radius, turn) {
  if (Math.abs(turn) * radius < 4) return; // pixels: less would be a speck
  const sense = Math.sign(turn);
  const head = Math.min(9, Math.abs(turn) * radius);
  const start = -Math.PI / 2;
  const neck = start - turn + (sense * head) / radius;
  for (const [width, style] of [[6, colour("raised")], [2.5, colour("torque")]]) {
    context.lineWidth = width;
    context.strokeStyle = context.fillStyle = style;
    context.lineCap = "butt";
    context.beginPath();
    context.arc(x, y, radius, start, neck, sense > 0);
    context.stroke();
    paintHead(context, x, y, radius, { neck, sense, head, wide: head * 0.55 + (width - 2.5) / 2 });
  }
}

function paintHead(context, x, y, radius, { neck, sense, head, wide }) {
  const [outX, outY] = [Math.cos(neck), Math.sin(neck)];
  const [aheadX, aheadY] = [outY * sense, -outX * sense];
  const [baseX, baseY] = [x + radius * outX, y + radius * outY];
  context.beginPath();
  context.moveTo(baseX + wide * outX, baseY + wide * outY);
  context.lineTo(baseX + head * aheadX, baseY + head * aheadY);
  context.lineTo(baseX - wide * outX, baseY - wide * outY);
  context.fill();
}
