// Where the bodies of a robot are at its joint positions, as MuJoCo computes it. Quaternions are [w, x, y, z].

/** The poses {place, turn} of all bodies, the world first: where they are, and their rotations as 9 numbers by rows. */
export function bodyPoses(space, qpos) {
  const poses = [{ place: [0, 0, 0], quaternion: [1, 0, 0, 0], turn: rotationOf([1, 0, 0, 0]) }];
  const joints = jointsOf(space);
  space.bodies.forEach((body, i) => {
    const parent = poses[body.parent];
    const pose = {
      place: add(parent.place, turned(parent.turn, body.position)),
      quaternion: product(parent.quaternion, body.turn),
    };
    for (const joint of joints[i + 1]) move(pose, joint, qpos);
    pose.quaternion = unit(pose.quaternion);
    pose.turn = rotationOf(pose.quaternion);
    poses.push(pose);
  });
  return poses;
}

/** The pose of what is fixed to a body at a position and a turn. */
export function poseOn(poses, { body, position, turn }) {
  const { place, turn: rotation, quaternion } = poses[body];
  return { place: add(place, turned(rotation, position)), turn: rotationOf(product(quaternion, unit(turn))) };
}

const jointLists = new WeakMap();

/** The joints of each body. */
function jointsOf(space) {
  if (!jointLists.has(space)) {
    const lists = Array.from({ length: space.bodies.length + 1 }, () => []);
    for (const joint of space.joints) lists[joint.body].push(joint);
    jointLists.set(space, lists);
  }
  return jointLists.get(space);
}

/** Moves a body by one of its joints. */
function move(pose, { kind, first, position, axis, reference }, qpos) {
  if (kind === "free") {
    pose.place = [qpos[first], qpos[first + 1], qpos[first + 2]];
    pose.quaternion = unit([3, 4, 5, 6].map((i) => qpos[first + i]));
    return;
  }
  const before = rotationOf(unit(pose.quaternion));
  if (kind === "slide") {
    const way = qpos[first] - reference;
    pose.place = add(pose.place, turned(before, axis.map((x) => x * way)));
    return;
  }
  const own = kind === "ball" ? unit([0, 1, 2, 3].map((i) => qpos[first + i])) : about(axis, qpos[first] - reference);
  const anchor = add(pose.place, turned(before, position));
  pose.quaternion = product(pose.quaternion, own);
  const after = turned(rotationOf(unit(pose.quaternion)), position);
  pose.place = anchor.map((x, i) => x - after[i]);
}

/** The rotation by an angle about a unit axis. */
function about(axis, angle) {
  return [Math.cos(angle / 2), ...axis.map((x) => x * Math.sin(angle / 2))];
}

function add(a, b) {
  return [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
}

/** A rotation of nine numbers, times a vector. */
export function turned(r, [x, y, z]) {
  return [r[0] * x + r[1] * y + r[2] * z, r[3] * x + r[4] * y + r[5] * z, r[6] * x + r[7] * y + r[8] * z];
}

function unit(q) {
  const length = Math.hypot(...q);
  return length > 0 ? q.map((x) => x / length) : [1, 0, 0, 0];
}

function product([a, b, c, d], [w, x, y, z]) {
  return [
    a * w - b * x - c * y - d * z,
    a * x + b * w + c * z - d * y,
    a * y - b * z + c * w + d * x,
    a * z + b * y - c * x + d * w,
  ];
}

function rotationOf([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ].flat();
}
