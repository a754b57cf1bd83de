// The outline of a part: the convex hull of what the camera sees of its points.

/** Where the camera sees the points of a part: place + turn * point. */
export function pointsSeen(part, [x, y, xx, xy, xz, yx, yy, yz]) {
  return part.points.map(([a, b, c]) => [x + xx * a + xy * b + xz * c, y + yx * a + yy * b + yz * c]);
}

/** The corners of the convex hull, going around it. */
export function hull(points) {
  const sorted = [...points].sort(([ax, ay], [bx, by]) => ax - bx || ay - by);
  return [...halfHull(sorted), ...halfHull(sorted.reverse())];
}

/** The corners of the hull on one side of sorted points, without the last one. */
function halfHull(sorted) {
  const corners = [];
  for (const [x, y] of sorted) {
    while (corners.length > 1) {
      const [[ax, ay], [bx, by]] = corners.slice(-2);
      if ((bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0) break;
      corners.pop();
    }
    corners.push([x, y]);
  }
  return corners.length > 1 ? corners.slice(0, -1) : corners;
}
