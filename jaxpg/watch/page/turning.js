// Turning the camera around a robot in space: by dragging, by keys, and nearer or farther.

import { clamp } from "./numbers.js";

const DEGREES = 0.5; // for each pixel of a drag
const STILL = 4; // pixels: less is a click
const VIEWS = [null, [90, 0], [180, 0], [90, -89.9]]; // as it is at first, from the side, from the front, from above

/** The camera's {azimuth, elevation, zoom}, and what changes it. `paint` is called after each change. */
export function startTurning(canvas, { azimuth, elevation }, paint) {
  const view = { azimuth, elevation: clamp(elevation, -89.9, 10), zoom: 1 };
  const first = { ...view };
  const set = (changes) => {
    Object.assign(view, changes);
    paint();
  };
  let [number, dragged] = [0, false];
  drag(canvas, {
    begin: () => { dragged = false; },
    move: (dx, dy) => {
      dragged = true;
      set({ azimuth: view.azimuth - DEGREES * dx, elevation: clamp(view.elevation - DEGREES * dy, -89.9, 10) });
    },
  });
  canvas.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey) return; // else the page scrolls; a touch pad sends ctrlKey when pinched
    event.preventDefault();
    set({ zoom: clamp(view.zoom * Math.exp(-0.01 * event.deltaY), 0.5, 4) });
  }, { passive: false });
  return {
    view,
    wasDragged: () => dragged,
    next: () => {
      number = (number + 1) % VIEWS.length;
      const [to, down] = VIEWS[number] ?? [first.azimuth, first.elevation];
      set({ azimuth: to, elevation: down, zoom: 1 });
    },
  };
}

/** Calls move(dx, dy) while a pointer is dragged over a canvas; a finger that begins up or down scrolls the page. */
function drag(canvas, { begin, move }) {
  let [start, last] = [null, null];
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    start = last = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
    begin();
  });
  canvas.addEventListener("pointermove", (event) => {
    const here = [event.clientX, event.clientY];
    if (!last || (last === start && Math.hypot(here[0] - start[0], here[1] - start[1]) < STILL)) return;
    move(here[0] - last[0], here[1] - last[1]);
    last = here;
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { last = null; });
}
