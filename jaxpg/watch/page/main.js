// The page from top to bottom; what the data does not have is not there.

import { curves } from "./curves.js";
import { element } from "./dom.js";
import { keysLine, startKeys } from "./keys.js";
import { seriesNumbers } from "./palette.js";
import { panels } from "./panels.js";
import { choices, stage } from "./player.js";
import { portrait } from "./portrait.js";
import { shared, startOf } from "./rollout.js";
import { facts, folded, improvement, noted } from "./tables.js";
import { startTheme } from "./theme.js";
import { workspace } from "./workspace.js";

const data = JSON.parse(document.getElementById("data").textContent);

function section(title, ...children) {
  return element("section", {}, element("h2", {}, title), ...children);
}

function linkedViews() {
  const view = shared(startOf(data));
  const { player } = data;
  const views = element("div", { class: player?.space ? "views in-space" : "views" });
  if (player) views.append(stage(player, view));
  if (data.portrait) views.append(portrait(data.portrait, player, view));
  if (data.workspace) views.append(workspace(data.workspace, player, view));
  if (player) views.append(panels(player, view));
  if (!views.children.length) return [];
  if (!player) return [section("Policy", views)];
  startKeys(player, view);
  return [section("Rollout", choices(player, view), views, keysLine(player))];
}

/** Panels of curves; a series has the same colour in all panels of the page. */
function learning(title, panels, kind) {
  if (!panels.length) return [];
  const numberOf = seriesNumbers([...data.curves, ...data.diagnostics]);
  return [section(title, element("div", { class: kind }, ...panels.map((panel) => curves(panel, numberOf))))];
}

/** What `build` makes; if it fails, a line that says so, and the rest of the page goes on. */
function part(title, build) {
  try {
    return build();
  } catch (error) {
    console.error(error);
    return [section(title, element("p", { class: "note" }, `This part could not be drawn: ${error.message}`))];
  }
}

function tables() {
  return data.tables.map((one) => section(one.title, ...noted(one)));
}

/** What could not be drawn, and what one has to know of the numbers. */
function remarks(notes) {
  if (!notes.length) return [];
  return [element("ul", { class: "remarks" }, ...notes.map((line) => element("li", {}, line)))];
}

function repeating(command) {
  return command ? [section("The same run again", element("pre", {}, command))] : [];
}

function start() {
  document.getElementById("kind").textContent = data.kind === "run" ? "training run" : "comparison of runs";
  const main = document.getElementById("main");
  startTheme();
  main.replaceChildren(
    facts(data.facts),
    ...(data.head ? noted(data.head) : []),
    ...remarks(data.notes),
    ...part("Rollout", linkedViews),
    ...part("Learning", () => learning("Learning", data.curves, "figures")),
    ...part("Tables", tables),
    ...part("Diagnostics", () => learning("Diagnostics", data.diagnostics, "figures small")),
  );
  if (data.improvement) main.append(section("Probability of improvement", ...improvement(data.improvement)));
  main.append(...repeating(data.command));
  for (const [title, rows] of [["Configuration", data.configuration], ["Versions", data.versions]]) {
    if (rows.length) main.append(folded(title, rows));
  }
}

start();
