// What all tabs use: elements, numbers as text, messages and colours.

const FORMAT = /* format */ 0;
const VERSION = /* version */ "";
const SVG = "http://www.w3.org/2000/svg";
const DASHES = [[], [7, 3], [2, 3], [9, 3, 2, 3]];
const byId = (id) => document.getElementById(id);
const say = (texts) => Object.entries(texts).forEach(([id, text]) => (byId(id).textContent = text));
const hide = (away) => Object.entries(away).forEach(([id, hidden]) => (byId(id).hidden = hidden));
const fill = (id, children) => byId(id).replaceChildren(...children);
const on = (id, action) => byId(id).addEventListener(byId(id).tagName === "BUTTON" ? "click" : "change", action);
const series = (place) => `var(--series-${place})`;
const sum = (numbers) => numbers.reduce((total, each) => total + each, 0);
const mean = (numbers) => sum(numbers) / numbers.length;
const percent = (share) => `${(100 * share).toFixed(0)}%`;
const withUnit = (text, unit) => (unit ? `${text} ${unit}` : text);
const titled = (objective) => (objective.unit ? `${objective.name} (${objective.unit})` : objective.name);
const plain = (end) => end.replaceAll("_", " ");
const capital = (text) => text[0].toUpperCase() + text.slice(1);

class Refusal extends Error {}

function filled(made, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (value !== false) made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children);
  return made;
}

const element = (name, attributes = {}, ...children) => filled(document.createElement(name), attributes, children);
const svg = (name, attributes = {}, ...children) => filled(document.createElementNS(SVG, name), attributes, children);
const times = (count, make) => Array.from({ length: count }, (_, k) => make(k));
const cells = (texts, name = "td", attributes = {}) => texts.map((text) => element(name, attributes, text));
const options = (texts) => texts.map((text, value) => element("option", { value }, text));

/** Fill a table: a row of headings, then rows that begin with a heading, of texts or of elements. */
function fillTable(table, headings, rows) {
  table.replaceChildren(
    element("thead", {}, element("tr", {}, ...cells(headings, "th", { scope: "col" }))), element("tbody", {}, ...rows));
}

/** A number with the digits that distinguish values that differ by `extent`. */
function formatted(value, extent, signed = false) {
  const digits = extent > 0 ? Math.min(Math.max(2 - Math.floor(Math.log10(extent)), 0), 4) : 2;
  const text = (Number(value.toFixed(digits)) + 0).toFixed(digits).replace("-", "−");
  return signed && value > 0 && Number(value.toFixed(digits)) > 0 ? `+${text}` : text;
}

function slider({ id, label, value, max, step, text, change }) {
  const output = element("output", { for: id }, text(value));
  const input = element("input", { type: "range", id, min: 0, max, step, value, "aria-valuetext": text(value), oninput: () => {
      output.textContent = text(Number(input.value));
      input.setAttribute("aria-valuetext", output.textContent);
      change(Number(input.value));
    } });
  return element("div", { class: "slider" }, element("label", { for: id }, label), output, input);
}

/** A piece of the line of the policy at a place: its colour and its dashes. */
const swatch = (place) => svg("svg", { width: 32, height: 8, "aria-hidden": "true" },
  svg("line", { x1: 0, y1: 4, x2: 26, y2: 4, stroke: series(place), "stroke-width": 3.5, "stroke-dasharray": DASHES[place].join(" ") }));

async function copy(text, what, note) {
  try {
    await navigator.clipboard.writeText(text);
    note.textContent = `The ${what} is copied.`;
  } catch {
    note.textContent = `The browser does not allow to copy; the ${what} is: ${text}`;
  }
}

function showMessage(text) { byId("message").textContent = text; byId("message").hidden = !text; }

/** Show what went wrong: a refusal in its own words. */
function showError(error) {
  if (!(error instanceof Refusal)) console.error(error);
  showMessage(error instanceof Refusal ? error.message : `This page cannot be shown: ${error.message}`);
}

const scheme = matchMedia("(prefers-color-scheme: dark)");

function setTheme() {
  const dark = byId("theme").value === "dark" || (byId("theme").value === "auto" && scheme.matches);
  document.documentElement.dataset.theme = dark ? "dark" : "light";
}

for (const each of [scheme, byId("theme")]) each.addEventListener("change", setTheme);
setTheme();
