// Light and dark: the system's choice until the button says otherwise; paper is always light.

import { element } from "./dom.js";

const themeListeners = [];
const colours = new Map();

/** Calls draw() whenever the colours change; needed by canvases, which do not follow the style sheet. */
export function onTheme(draw) {
  themeListeners.push(draw);
}

/** The value that a colour of the style sheet has now, as "rgb(...)". */
export function colour(name) {
  if (!colours.has(name)) {
    const probe = document.body.appendChild(element("span", { hidden: true }));
    probe.style.color = `var(--${name})`;
    colours.set(name, getComputedStyle(probe).color);
    probe.remove();
  }
  return colours.get(name);
}

function isDark() {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
}

function setTheme(theme) {
  if (theme) document.documentElement.dataset.theme = theme;
  else delete document.documentElement.dataset.theme;
  showTheme();
}

function showTheme() {
  const other = isDark() ? "light" : "dark";
  const button = document.getElementById("theme");
  button.textContent = other;
  button.setAttribute("aria-label", `use ${other} colours`);
  colours.clear();
  for (const draw of themeListeners) draw();
}

export function startTheme() {
  let before;
  document.getElementById("theme").addEventListener("click", () => setTheme(isDark() ? "light" : "dark"));
  for (const media of ["(prefers-color-scheme: dark)", "print"]) {
    matchMedia(media).addEventListener("change", showTheme);
  }
  addEventListener("beforeprint", () => {
    before = document.documentElement.dataset.theme;
    setTheme("light");
  });
  addEventListener("afterprint", () => setTheme(before));
  showTheme();
}
