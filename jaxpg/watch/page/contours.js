// Lines of equal value on a grid.

/** The segments [[x0, y0], [x1, y1]] in columns and rows where the values cross a level. */
export function contour(values, columns, rows, level) {
  const segments = [];
  for (let row = 0; row + 1 < rows; row++) {
    for (let column = 0; column + 1 < columns; column++) {
      const points = crossings(values, columns, row, column, level);
      for (let i = 0; i + 1 < points.length; i += 2) segments.push([points[i], points[i + 1]]);
    }
  }
  return segments;
}

const CORNERS = [[0, 0], [1, 0], [1, 1], [0, 1]];

/** Where the level crosses the edges of a cell, going around it. */
function crossings(values, columns, row, column, level) {
  const points = [];
  CORNERS.forEach(([x0, y0], i) => {
    const [x1, y1] = CORNERS[(i + 1) % 4];
    const from = values[(row + y0) * columns + column + x0];
    const to = values[(row + y1) * columns + column + x1];
    if (from < level === to < level) return;
    const share = (level - from) / (to - from);
    points.push([column + x0 + share * (x1 - x0), row + y0 + share * (y1 - y0)]);
  });
  return points;
}
