// A camera in space: it looks along an azimuth and an elevation (degrees, as MuJoCo's) at a centre.

const HALF_FIELD = (17.5 * Math.PI) / 180; // half the angle that it sees, upwards or sideways if that is narrower
const NEAR = 0.05; // nothing nearer is drawn, as a fraction of the distance to the centre

/** A camera that sees a sphere of a radius about a centre as large as it fits into so many pixels, times the zoom. */
export function makeCamera({ center, radius, azimuth, elevation, zoom = 1 }, width, height) {
  const axes = cameraAxes(azimuth, elevation);
  const distance = radius / Math.sin(HALF_FIELD) / zoom;
  const eye = center.map((x, i) => x + distance * axes.back[i]);
  const focal = Math.min(width, height) / 2 / Math.tan(HALF_FIELD);
  return { ...axes, eye, focal, x: width / 2, y: height / 2, near: NEAR * distance, distance };
}

/** Unit vectors to the right, upwards and towards the viewer. */
export function cameraAxes(azimuth, elevation) {
  const [a, e] = [azimuth, elevation].map((degrees) => (degrees * Math.PI) / 180);
  const [ca, sa, ce, se] = [Math.cos(a), Math.sin(a), Math.cos(e), Math.sin(e)];
  return { right: [sa, -ca, 0], up: [-se * ca, -se * sa, ce], back: [-ce * ca, -ce * sa, -se] };
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/** Pixels from the left and from the top, and the distance in front of the camera. */
export function project(camera, point) {
  const from = [point[0] - camera.eye[0], point[1] - camera.eye[1], point[2] - camera.eye[2]];
  const depth = -dot(camera.back, from);
  const scale = camera.focal / depth;
  return [camera.x + scale * dot(camera.right, from), camera.y - scale * dot(camera.up, from), depth];
}

/** Both ends of what the camera sees of a line, in pixels; null if it is behind the camera. */
export function projectLine(camera, from, to) {
  const [a, b] = [from, to].map((point) => project(camera, point)[2] - camera.near);
  if (a <= 0 && b <= 0) return null;
  const cut = (share) => from.map((x, i) => x + (to[i] - x) * share);
  return [a <= 0 ? cut(a / (a - b)) : from, b <= 0 ? cut(a / (a - b)) : to].map((point) => project(camera, point));
}
