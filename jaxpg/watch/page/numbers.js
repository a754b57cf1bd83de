// Numbers: out of their packing, along an axis, and as text.

/** Integers out of base64 of little-endian int16. */
export function unpack(packed) {
  const bytes = Uint8Array.from(atob(packed), (character) => character.charCodeAt(0));
  const view = new DataView(bytes.buffer);
  return Int16Array.from({ length: bytes.length / 2 }, (_, i) => view.getInt16(2 * i, true));
}

/** Least and greatest of lists of numbers, nulls left out, with some room; [0, 1] where there are none. */
export function extent(lists, room = 0) {
  let low = Infinity;
  let high = -Infinity;
  for (const list of lists) {
    for (const value of list) {
      if (value === null || value === undefined) continue;
      low = Math.min(low, value);
      high = Math.max(high, value);
    }
  }
  if (low > high) return [0, 1];
  const margin = low === high ? Math.abs(low) * 0.1 || 0.5 : (high - low) * room;
  return [low - margin, high + margin];
}

/** 1, 2 or 5 times a power of ten: the least such step that takes at most `count` steps over the span. */
export function niceStep(span, count) {
  const power = 10 ** Math.floor(Math.log10(span / count));
  const factor = [1, 2, 5, 10].find((f) => f * power * count >= span * (1 - 1e-9)) ?? 10;
  return factor * power;
}

/** Values at which an axis is marked, and the text of each. */
export function ticks([low, high], count) {
  const step = niceStep(high - low, count);
  const values = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i++) values.push(i * step || 0);
  const largest = Math.max(...values.map(Math.abs));
  return values.map((value) => ({ value, text: tickText(value, step, largest) }));
}

/** Ticks of an angle that goes once around: multiples of pi / 2. */
export function angleTicks() {
  const texts = ["−π", "−π/2", "0", "π/2", "π"];
  return texts.map((text, i) => ({ value: ((i - 2) * Math.PI) / 2, text }));
}

function tickText(value, step, largest) {
  if (value === 0) return "0";
  if (largest >= 1e9 || largest < 1e-3) return minus(String(Number(value.toPrecision(3)).toExponential()));
  if (largest >= 1e4 && Math.abs(value) >= 1e6) return minus(`${Number((value / 1e6).toPrecision(6))}M`);
  if (largest >= 1e4 && Math.abs(value) >= 1e3) return minus(`${Number((value / 1e3).toPrecision(6))}k`);
  return minus(value.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9))));
}

/** A number to be read: four digits, whole thousands grouped; a dash where there is none. */
export function text(value) {
  if (value === null || value === undefined) return "–";
  const size = Math.abs(value);
  if (size >= 1e9 || (size > 0 && size < 1e-4)) return minus(value.toExponential(3));
  if (size >= 1e4) return minus(Math.round(value).toLocaleString("en"));
  return minus(String(Number(value.toPrecision(4))));
}

/** A number with so many decimals, for readings that change while one looks: the width stays the same. */
export function fixed(value, decimals) {
  if (value === null || value === undefined) return "–";
  const rounded = value.toFixed(decimals);
  return minus(Number(rounded) === 0 ? rounded.replace("-", "") : rounded);
}

function minus(string) {
  return string.replaceAll("-", "−");
}

export function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}
