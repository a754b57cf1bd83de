// Elements of the page and of its drawings. Text always becomes a text node: no data is read as HTML.

const DRAWING = "http://www.w3.org/2000/svg"; // the name of SVG's elements; nothing is fetched from it

/** An HTML element; attributes that are null or false are left out, children are elements or texts. */
export function element(name, attributes = {}, ...children) {
  return filled(document.createElement(name), attributes, children);
}

/** An SVG element. */
export function shape(name, attributes = {}, ...children) {
  return filled(document.createElementNS(DRAWING, name), attributes, children);
}

function filled(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.filter((child) => child !== null));
  return node;
}

/** A figure: a title, whatever is drawn, and a line of text below. */
export function figure(title, ...children) {
  return element("figure", {}, element("h3", {}, title), ...children);
}

/** Calls draw(width) now that the node has a width, and whenever it has another one. */
export function onWidth(node, draw) {
  let known = 0;
  new ResizeObserver(() => {
    const width = Math.floor(node.clientWidth);
    if (width === 0 || width === known) return;
    known = width;
    draw(width);
  }).observe(node);
}

/** The mark of an episode: a disc for success, a cross for failure, so that colour is not needed. */
export function mark(success, x, y, size, ...children) {
  const path = success ? disc(x, y, size) : cross(x, y, size * 0.85);
  return shape("path", { d: path, class: success ? "success" : "failure" }, ...children);
}

function disc(x, y, r) {
  return `M${x - r} ${y}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0`;
}

function cross(x, y, r) {
  return `M${x - r} ${y - r}l${2 * r} ${2 * r}M${x - r} ${y + r}l${2 * r} ${-2 * r}`;
}

/** A mark among words. */
export function inlineMark(success) {
  return shape("svg", { class: "mark", width: 10, height: 10, "aria-hidden": "true" }, mark(success, 5, 5, 4));
}
