// Surfaces of triangles, and how light falls on them.

import { project } from "./camera.js";
import { turned } from "./kinematics.js";
import { unpack } from "./numbers.js";
import { paintTriangle } from "./raster.js";

const CREASE = Math.cos((40 * Math.PI) / 180); // at a sharper edge the light changes at once
const meshesOfParts = new WeakMap();

/** The surface of a part, unpacked. */
export function meshOf(part) {
  if (!meshesOfParts.has(part)) {
    const vertices = Float64Array.from(unpack(part.vertices), (x) => x * part.unit);
    meshesOfParts.set(part, makeMesh(vertices, unpack(part.triangles)));
  }
  return meshesOfParts.get(part);
}

/** {vertices, triangles, normals}: of each corner of a triangle the mean normal of the faces that go on smoothly. */
function makeMesh(vertices, triangles) {
  const faces = [];
  const facesAt = new Map();
  for (let t = 0; t < triangles.length / 3; t++) {
    faces.push(faceNormal(vertices, triangles, 3 * t));
    for (let k = 0; k < 3; k++) {
      const vertex = triangles[3 * t + k];
      if (!facesAt.has(vertex)) facesAt.set(vertex, []);
      facesAt.get(vertex).push(t);
    }
  }
  const normals = new Float32Array(3 * triangles.length);
  triangles.forEach((vertex, corner) => {
    const own = faces[Math.floor(corner / 3)];
    const smooth = facesAt.get(vertex).map((t) => faces[t]).filter((n) => cosine(n, own) > CREASE);
    const sum = [0, 1, 2].map((k) => smooth.reduce((total, n) => total + n[k], 0));
    const length = Math.hypot(...sum) || 1;
    for (let k = 0; k < 3; k++) normals[3 * corner + k] = sum[k] / length;
  });
  return { vertices, triangles, normals };
}

/** The normal of a face, as long as twice its area. */
function faceNormal(vertices, triangles, first) {
  const [a, b, c] = [0, 1, 2].map((k) => vertices.slice(3 * triangles[first + k], 3 * triangles[first + k] + 3));
  const [ux, uy, uz] = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
  const [vx, vy, vz] = [c[0] - a[0], c[1] - a[1], c[2] - a[2]];
  return [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
}

function cosine(a, b) {
  const size = Math.hypot(...a) * Math.hypot(...b);
  return size > 0 ? (a[0] * b[0] + a[1] * b[1] + a[2] * b[2]) / size : -1;
}

/** A ball of radius 1. */
export function globe(meridians = 20, parallels = 9) {
  const vertices = [0, 0, 1];
  for (let i = 1; i <= parallels; i++) {
    const latitude = Math.PI / 2 - (Math.PI * i) / (parallels + 1);
    for (let j = 0; j < meridians; j++) {
      const longitude = (2 * Math.PI * j) / meridians;
      const across = Math.cos(latitude);
      vertices.push(across * Math.cos(longitude), across * Math.sin(longitude), Math.sin(latitude));
    }
  }
  vertices.push(0, 0, -1);
  const last = vertices.length / 3 - 1;
  const at = (i, j) => (i === 0 ? 0 : i > parallels ? last : 1 + (i - 1) * meridians + (j % meridians));
  const triangles = [];
  for (let i = 0; i <= parallels; i++) {
    for (let j = 0; j < meridians; j++) {
      if (i > 0) triangles.push(at(i, j), at(i + 1, j), at(i, j + 1));
      if (i < parallels) triangles.push(at(i, j + 1), at(i + 1, j), at(i + 1, j + 1));
    }
  }
  return makeMesh(Float64Array.from(vertices), Int16Array.from(triangles));
}

/** A bar along an axis (0, 1, 2) from the origin. */
export function barMesh(axis, length, width) {
  const vertices = [];
  for (let i = 0; i < 8; i++) {
    const corner = [0, 1, 2].map((k) => ((i >> k) & 1 ? 1 : -1) * (width / 2));
    corner[axis] = (i >> axis) & 1 ? length : 0;
    vertices.push(...corner);
  }
  const faces = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
  const triangles = faces.flatMap(([a, b, c, d]) => [a, b, c, a, c, d]);
  return makeMesh(Float64Array.from(vertices), Int16Array.from(triangles));
}

/** The vertices of a mesh at a pose {place, turn, scale}, in the world. */
export function placedVertices(mesh, { place, turn, scale = 1 }) {
  const points = [];
  for (let i = 0; i < mesh.vertices.length; i += 3) {
    const [x, y, z] = turned(turn, [mesh.vertices[i], mesh.vertices[i + 1], mesh.vertices[i + 2]]);
    points.push([place[0] + scale * x, place[1] + scale * y, place[2] + scale * z]);
  }
  return points;
}

/** Paints a mesh at a pose, in the light {direction, darkest, brightest}. */
export function paintMesh(raster, camera, light, mesh, pose, colour, opacity = 1) {
  const seen = placedVertices(mesh, pose).map((point) => project(camera, point));
  const corners = new Float64Array(9);
  for (let t = 0; t < mesh.triangles.length; t += 3) {
    let behind = false;
    for (let k = 0; k < 3; k++) {
      const [x, y, depth] = seen[mesh.triangles[t + k]];
      behind ||= depth < camera.near;
      corners.set([x, y, 1 / depth], 3 * k);
    }
    if (!behind) paintTriangle(raster, corners, cornerLights(mesh, pose, light, t), colour, opacity);
  }
}

/** How bright the corners of a triangle are: darkest where they face away from the light. */
function cornerLights(mesh, { turn }, { direction, darkest, brightest }, first) {
  return [0, 1, 2].map((k) => {
    const at = 3 * (first + k);
    const normal = turned(turn, [mesh.normals[at], mesh.normals[at + 1], mesh.normals[at + 2]]);
    const facing = normal[0] * direction[0] + normal[1] * direction[1] + normal[2] * direction[2];
    return darkest + (brightest - darkest) * Math.max(0, 0.5 + 0.5 * facing) ** 1.5;
  });
}
