// Triangles as pixels: each pixel shows the nearest triangle, shaded. So no order of drawing is needed.

/** A picture with the nearness, 1 / depth, of each of its pixels. */
export function makeRaster(width, height) {
  const image = new ImageData(width, height);
  const colours = new Uint32Array(image.data.buffer);
  return { width, height, image, colours, nearness: new Float32Array(width * height) };
}

export function clearRaster(raster) {
  raster.colours.fill(0);
  raster.nearness.fill(0);
}

/**
 * Paints a triangle. `corners` are pixels from the left, from the top, and 1 / depth of three corners, nine numbers;
 * `lights` how bright they are. Only triangles that go counter-clockwise are seen. One that is not opaque is mixed with
 * what is behind it, and hides nothing.
 */
export function paintTriangle(raster, corners, lights, colour, opacity = 1) {
  const [ax, ay, aw, bx, by, bw, cx, cy, cw] = corners;
  const area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax);
  if (!(area < 0)) return; // pixels go downwards
  const { width, height, nearness } = raster;
  const top = Math.max(0, Math.ceil(Math.min(ay, by, cy) - 0.5));
  const bottom = Math.min(height - 1, Math.floor(Math.max(ay, by, cy) - 0.5));
  const left = Math.max(0, Math.ceil(Math.min(ax, bx, cx) - 0.5));
  const right = Math.min(width - 1, Math.floor(Math.max(ax, bx, cx) - 0.5));
  const [stepB, stepC] = [(cy - ay) / area, (ay - by) / area];
  for (let row = top; row <= bottom; row++) {
    const [x, y] = [left + 0.5 - ax, row + 0.5 - ay];
    let b = (x * (cy - ay) - y * (cx - ax)) / area;
    let c = (y * (bx - ax) - x * (by - ay)) / area;
    for (let i = row * width + left; i <= row * width + right; i++, b += stepB, c += stepC) {
      const a = 1 - b - c;
      if (a < 0 || b < 0 || c < 0) continue;
      const near = a * aw + b * bw + c * cw;
      if (near <= nearness[i]) continue;
      const light = a * lights[0] + b * lights[1] + c * lights[2];
      if (opacity === 1) nearness[i] = near;
      raster.colours[i] = mixed(raster.colours[i], colour, light, opacity);
    }
  }
}

/** A pixel of a colour [red, green, blue] in a light, over the pixel that is there: bytes red, green, blue, opacity. */
function mixed(under, colour, light, opacity) {
  const share = under >>> 24 ? opacity : 1;
  let pixel = Math.max(under >>> 24, Math.round(255 * opacity)) << 24;
  for (let k = 0; k < 3; k++) {
    const below = (under >>> (8 * k)) & 255;
    pixel |= Math.round(below + share * (Math.min(255, colour[k] * light) - below)) << (8 * k);
  }
  return pixel;
}
