// Facts, tables, the probabilities of improvement, and what is folded away.

import { element } from "./dom.js";
import { fixed } from "./numbers.js";

export function facts(rows) {
  return element("dl", { class: "facts" }, ...rows.map(pair));
}

function pair([name, words]) {
  return element("div", {}, element("dt", {}, name), element("dd", {}, words));
}

const NUMBER = /^([−-]?[\d.]|[–-]$|$)/; // what a cell about numbers begins with

/** A table, and what is to be said of it. */
export function noted({ title, columns, rows, note }) {
  return [table(title, columns, rows), note ? element("p", { class: "note" }, note) : null].filter(Boolean);
}

/** A table that scrolls by itself where it is too wide. */
function table(title, columns, rows) {
  const right = columns.map((_, i) => rows.length > 0 && rows.every((row) => NUMBER.test(row[i])));
  const kind = (i) => (right[i] ? "number" : null);
  const head = element("tr", {}, ...columns.map((name, i) => element("th", { scope: "col", class: kind(i) }, name)));
  const body = rows.map((row) =>
    element("tr", {}, ...row.map((words, i) => element("td", { class: kind(i) }, signed(String(words), right[i])))),
  );
  return scrolled(title, element("table", {}, element("thead", {}, head), element("tbody", {}, ...body)));
}

/** With true minus signs, if it is about numbers. */
function signed(words, number) {
  return number ? words.replace(/(^|[\s[(,])-(?=[\d.])/g, "$1−") : words;
}

function scrolled(title, content) {
  return element("div", { class: "scrolled", role: "region", tabindex: 0, "aria-label": title }, content);
}

const IMPROVEMENT =
  "The probability that a run of the row does better than a run of the column, with its interval; bold if the " +
  "interval excludes one half. There is no interval if there are too few seeds.";

/** P(row > column) of all pairs. */
export function improvement({ labels, probability, low, high }) {
  const numbers = labels.map((name, i) => element("th", { scope: "col", class: "number", title: name }, String(i + 1)));
  const rows = labels.map((name, i) => {
    const cells = labels.map((_, j) => probabilityCell(probability[i][j], low?.[i]?.[j], high?.[i]?.[j]));
    return element("tr", {}, element("th", { scope: "row" }, element("i", {}, String(i + 1)), ` ${name}`), ...cells);
  });
  const head = element("thead", {}, element("tr", {}, element("td", {}), ...numbers));
  const whole = element("table", { class: "matrix" }, head, element("tbody", {}, ...rows));
  return [element("p", { class: "note" }, IMPROVEMENT), scrolled("probability of improvement", whole)];
}

function probabilityCell(p, low, high) {
  if (p === null || p === undefined) return element("td", { class: "number" }, "–");
  const known = low !== null && low !== undefined && high !== null && high !== undefined;
  const sure = known && (low > 0.5 || high < 0.5);
  const words = element(sure ? "b" : "span", {}, fixed(p, 2));
  const cell = element("td", { class: sure && p > 0.5 ? "number better" : "number" }, words);
  cell.append(element("small", {}, known ? `${fixed(low, 2)} – ${fixed(high, 2)}` : "too few seeds"));
  return cell;
}

/** Pairs of name and value, folded; those with a default have another value than that. */
export function folded(title, rows) {
  const different = rows.filter(differs).length;
  const number = different ? `${rows.length}, ${different} not the default` : String(rows.length);
  const pairs = element("dl", { class: "pairs" }, ...rows.map(option));
  return element("details", {}, element("summary", {}, `${title} (${number})`), pairs);
}

function differs([, , byDefault]) {
  return byDefault !== null && byDefault !== undefined;
}

function option(row) {
  const node = pair(row);
  if (!differs(row)) return node;
  node.classList.add("differs");
  node.lastChild.append(element("small", {}, ` default ${row[2]}`));
  return node;
}
