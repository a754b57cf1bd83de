// The drawing of a rollout in space: the ground, the robot's shapes and their shadows, the goal, and frames of axes.

import { FONT } from "./axes.js";
import { cameraAxes, makeCamera, project, projectLine } from "./camera.js";
import { bodyPoses, poseOn } from "./kinematics.js";
import { barMesh, globe, meshOf, paintMesh, placedVertices } from "./meshes.js";
import { clamp, niceStep } from "./numbers.js";
import { hull } from "./outline.js";
import { clearRaster, makeRaster } from "./raster.js";
import { chosen, frameOf, ghostOf } from "./rollout.js";
import { sharp } from "./stage.js";
import { colour } from "./theme.js";

const LIGHT = { darkest: 0.45, brightest: 1.1 };
const FINEST = 1600; // pixels of the raster's width
const AXES_COLOURS = [[214, 60, 50], [60, 160, 70], [50, 110, 220]]; // x, y, z
const BALL = globe();

/** Paints the chosen episode at the state's position, seen from `view` {azimuth, elevation, zoom}. */
export function paintSpace(canvas, player, state, view) {
  const { space } = player;
  const context = sharp(canvas);
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (!width || !height) return;
  const episode = chosen(player, state);
  const ghost = ghostOf(player, state);
  const center = space.center.map((x, i) => x + (shiftOf(episode, state.position)[i] ?? 0));
  const looking = { center, radius: space.radius, ...view };
  const camera = makeCamera(looking, width, height);
  const poses = bodyPoses(space, qposAt(episode, state.position));
  const goal = goalAt(episode, frameOf(episode, state));
  paintGround(context, camera, space, center);
  if (view.elevation < 0) paintShadow(context, camera, space, poses);
  if (goal) paintPlumb(context, camera, space.ground, goal.place);
  const raster = rasterFor(canvas);
  const fine = makeCamera(looking, raster.width, raster.height);
  if (ghost) {
    clearRaster(raster);
    paintRobot(raster, fine, space, bodyPoses(space, qposAt(ghost, state.position)), () => numbersOf(colour("ghost")));
    lay(context, raster, width, height, 0.6);
  }
  clearRaster(raster);
  paintRobot(raster, fine, space, poses, (part) => visible(numbersOf(part.color)));
  if (goal) paintGoalBall(raster, fine, player, goal, space.site && poseOn(poses, space.site));
  lay(context, raster, width, height, 1);
  if (goal) paintGoalRing(context, camera, player, episode, goal.place);
  paintCompass(context, canvas, view);
}

/** The joint positions at a position between two frames. */
function qposAt(episode, position) {
  return rowAt(episode.qpos, episode.units, episode, position);
}

/** What is added to the centre: x and y. */
function shiftOf(episode, position) {
  return episode.shifts ? rowAt(episode.shifts, episode.shift_units, episode, position) : [];
}

function rowAt(numbers, units, episode, position) {
  const frame = clamp(Math.floor(position), 0, episode.frames - 1);
  const next = Math.min(frame + 1, episode.frames - 1);
  const share = clamp(position - frame, 0, 1);
  return units.map((unit, i) => {
    const [from, to] = [numbers[frame * units.length + i], numbers[next * units.length + i]];
    return (from + (to - from) * share) * unit;
  });
}

/** Where the goal is in a frame, and how it is turned or null; null without a goal. */
function goalAt(episode, frame) {
  const row = (rows) => rows && rows[Math.min(frame, rows.length - 1)];
  return episode.goals && { place: row(episode.goals), turn: row(episode.turns) };
}

/** A faint grid of squares on the ground about the centre, and how long their sides are. */
function paintGround(context, camera, { radius, ground }, center) {
  const mesh = niceStep(2 * radius, 8);
  const count = Math.ceil((1.4 * radius) / mesh);
  const [x, y] = [0, 1].map((i) => Math.round(center[i] / mesh) * mesh);
  const end = count * mesh;
  context.strokeStyle = colour("grid");
  context.lineWidth = 1;
  context.beginPath();
  for (let i = -count; i <= count; i++) {
    traceLine(context, camera, [x + i * mesh, y - end, ground], [x + i * mesh, y + end, ground]);
    traceLine(context, camera, [x - end, y + i * mesh, ground], [x + end, y + i * mesh, ground]);
  }
  context.stroke();
  context.fillStyle = colour("muted");
  context.font = `${FONT}px ${getComputedStyle(context.canvas).fontFamily}`;
  context.fillText(`grid ${Number(mesh.toPrecision(1))} m`, 14, context.canvas.clientHeight - 14);
}

function traceLine(context, camera, from, to) {
  const ends = projectLine(camera, from, to);
  if (!ends) return;
  context.moveTo(ends[0][0], ends[0][1]);
  context.lineTo(ends[1][0], ends[1][1]);
}

/** What hides the ground from a light straight above. */
function paintShadow(context, camera, space, poses) {
  context.beginPath();
  for (const part of space.parts) {
    const flat = placedVertices(meshOf(part), poses[part.body]).map(([x, y]) => project(camera, [x, y, space.ground]));
    if (flat.some(([, , depth]) => depth < camera.near)) continue;
    hull(flat).forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
    context.closePath();
  }
  context.fillStyle = colour("shadow");
  context.fill();
}

/** A line from a place straight down, or up, to the ground. */
function paintPlumb(context, camera, ground, [x, y, z]) {
  context.strokeStyle = colour("success");
  context.lineWidth = 1;
  context.setLineDash([3, 3]);
  context.beginPath();
  traceLine(context, camera, [x, y, z], [x, y, ground]);
  context.stroke();
  context.setLineDash([]);
}

function paintRobot(raster, camera, space, poses, colourOf) {
  for (const part of space.parts) {
    paintMesh(raster, camera, lightOf(camera), meshOf(part), poses[part.body], colourOf(part));
  }
}

/** A light from above the viewer's left shoulder. */
function lightOf({ right, up, back }) {
  const direction = [0, 1, 2].map((i) => 0.6 * back[i] + 0.5 * up[i] - 0.4 * right[i] + (i === 2 ? 0.3 : 0));
  const length = Math.hypot(...direction);
  return { direction: direction.map((x) => x / length), ...LIGHT };
}

/** The goal as a ball that can be seen through; if it is turned, with the axes of its frame and of the site's. */
function paintGoalBall(raster, camera, player, { place, turn }, site) {
  const size = Math.max(3 * (player.goal_radius ?? 0), 0.12 * player.space.radius);
  if (turn) paintAxes(raster, camera, { place, turn }, size, size / 18);
  if (turn && site) paintAxes(raster, camera, site, 0.6 * size, size / 9);
  const ball = { place, turn: [1, 0, 0, 0, 1, 0, 0, 0, 1], scale: goalRadius(player) };
  paintMesh(raster, camera, lightOf(camera), BALL, ball, numbersOf(colour("success")), 0.45);
}

function goalRadius({ goal_radius: radius, space }) {
  return radius ?? 0.02 * space.radius;
}

function paintAxes(raster, camera, pose, length, width) {
  for (let axis = 0; axis < 3; axis++) {
    paintMesh(raster, camera, lightOf(camera), barMesh(axis, length, width), pose, AXES_COLOURS[axis]);
  }
}

/** A ring around the goal, also where the robot hides it; thick where the episode ends in success. */
function paintGoalRing(context, camera, player, episode, place) {
  const [x, y, depth] = project(camera, place);
  if (depth < camera.near) return;
  context.beginPath();
  context.arc(x, y, Math.max(5, (goalRadius(player) * camera.focal) / depth), 0, 2 * Math.PI);
  context.strokeStyle = colour("success");
  context.lineWidth = episode.success ? 2.5 : 1;
  context.stroke();
}

/** The directions x, y and z, in a corner. */
function paintCompass(context, canvas, { azimuth, elevation }) {
  const { right, up, back } = cameraAxes(azimuth, elevation);
  const [x, y] = [canvas.clientWidth - 38, canvas.clientHeight - 34];
  const arrows = ["x", "y", "z"].map((name, i) => ({ name, i }));
  context.textAlign = "center";
  for (const { name, i } of arrows.sort((a, b) => back[a.i] - back[b.i])) {
    const [dx, dy] = [20 * right[i], -20 * up[i]];
    context.strokeStyle = `rgb(${AXES_COLOURS[i]})`;
    context.lineWidth = 2;
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(x + dx, y + dy);
    context.stroke();
    context.fillStyle = colour("muted");
    context.fillText(name, x + 1.4 * dx, y + 1.4 * dy + 4);
  }
  context.textAlign = "left";
}

const rasters = new WeakMap();

/** The raster of a canvas: twice as fine as it where that is not too much, which smooths edges. */
function rasterFor(canvas) {
  const factor = devicePixelRatio < 2 && 2 * canvas.width <= FINEST ? 2 : 1;
  const [width, height] = [factor * canvas.width, factor * canvas.height];
  const known = rasters.get(canvas);
  if (known?.width === width && known.height === height) return known;
  const raster = Object.assign(makeRaster(width, height), { sheet: document.createElement("canvas") });
  Object.assign(raster.sheet, { width, height });
  rasters.set(canvas, raster);
  return raster;
}

/** Lays the raster over what is painted. */
function lay(context, raster, width, height, opacity) {
  raster.sheet.getContext("2d").putImageData(raster.image, 0, 0);
  context.globalAlpha = opacity;
  context.imageSmoothingQuality = "high";
  context.drawImage(raster.sheet, 0, 0, width, height);
  context.globalAlpha = 1;
}

/** A colour that is not lost on the background: black is a grey, the lighter where the page is dark. */
function visible(rgb) {
  const least = numbersOf(colour("raised"))[0] < 128 ? 64 : 16;
  return rgb.map((x) => least + (x * (255 - least)) / 255);
}

const numbers = new Map();

/** [red, green, blue] of "#rrggbb" or "rgb(r, g, b)". */
function numbersOf(text) {
  if (!numbers.has(text)) {
    const isHex = text.startsWith("#");
    const found = isHex ? text.match(/\w\w/g).map((x) => parseInt(x, 16)) : text.match(/[\d.]+/g).map(Number);
    numbers.set(text, found.slice(0, 3));
  }
  return numbers.get(text);
}
