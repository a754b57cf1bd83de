// Colours of a map: lightness rises evenly from low to high, the hue turns from indigo over teal to yellow.

import { element } from "./dom.js";
import { clamp } from "./numbers.js";

export const SHADES = 256;

/** sRGB of a shade in [0, 1], computed in OKLab, where equal steps look equal. */
function shade(t) {
  const lightness = 0.28 + 0.64 * t;
  const hue = ((285 - 185 * t) * Math.PI) / 180;
  const chroma = 0.1 + 0.03 * t;
  const a = chroma * Math.cos(hue);
  const b = chroma * Math.sin(hue);
  const l = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3;
  const m = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3;
  const s = (lightness - 0.0894841775 * a - 1.291485548 * b) ** 3;
  return [
    4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s,
    -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s,
    -0.0041960863 * l - 0.7034186147 * m + 1.707614701 * s,
  ].map(gamma);
}

function gamma(linear) {
  const x = clamp(linear, 0, 1);
  return Math.round(255 * (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055));
}

const SHADE_TABLE = Array.from({ length: SHADES }, (_, i) => shade(i / (SHADES - 1)));

/** A picture of columns x rows pixels; paint(column, row) is a shade in [0, 1], row 0 at the lower edge. */
export function shadePicture(columns, rows, paint) {
  const canvas = element("canvas", { width: columns, height: rows });
  const context = canvas.getContext("2d");
  const image = context.createImageData(columns, rows);
  for (let row = 0; row < rows; row++) {
    for (let column = 0; column < columns; column++) {
      const index = Math.round(clamp(paint(column, row), 0, 1) * (SHADES - 1));
      image.data.set([...SHADE_TABLE[index], 255], 4 * ((rows - 1 - row) * columns + column));
    }
  }
  context.putImageData(image, 0, 0);
  return canvas;
}

/** Which colour of the series each label has: the same in every panel that shows several. */
export function seriesNumbers(panels) {
  const numbers = new Map();
  for (const panel of panels) {
    for (const { label } of panel.series) if (!numbers.has(label)) numbers.set(label, numbers.size);
  }
  return (label) => numbers.get(label) ?? 0;
}

const SERIES_COLOURS = 7;

/** Classes of a series' colour, and of its dashes once the colours are used up. */
export function seriesClass(number) {
  return `series s${number % SERIES_COLOURS} d${Math.floor(number / SERIES_COLOURS) % 3}`;
}
