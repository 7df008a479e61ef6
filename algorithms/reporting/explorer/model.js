// The data of the page, what follows from them, and the link that keeps a choice.

const FORMAT = /* format */ 0;
const MOST_COMPARED = 3;
const byId = (id) => document.getElementById(id);

class Refusal extends Error {}

function readData(text) {
  let data;
  try {
    data = JSON.parse(text);
  } catch {
    throw new Refusal("The data of this page are broken. Write the page again with mo-deepdrive explore.");
  }
  if (data?.format !== FORMAT) {
    throw new Refusal(`The data of this page have format ${String(data?.format)}; its code reads format ${FORMAT}. `
      + "Write the page again with mo-deepdrive explore.");
  }
  if (!Array.isArray(data.fronts) || data.fronts.length === 0) throw new Refusal("This page has no front.");
  return data.fronts;
}

function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (value !== false) made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children);
  return made;
}

/** A number with the digits that distinguish values that differ by `extent`. */
function formatted(value, extent, signed = false) {
  const digits = extent > 0 ? Math.min(Math.max(2 - Math.floor(Math.log10(extent)), 0), 4) : 2;
  const text = (Number(value.toFixed(digits)) + 0).toFixed(digits).replace("-", "−");
  return signed && value > 0 && Number(value.toFixed(digits)) > 0 ? `+${text}` : text;
}

const withUnit = (text, unit) => (unit ? `${text} ${unit}` : text);
const titled = (objective) => (objective.unit ? `${objective.name} (${objective.unit})` : objective.name);

/** One front with what follows from its data. */
class FrontModel {
  constructor(stored) {
    Object.assign(this, stored);
    this.size = stored.returns.length;
    this.means = stored.returns.map(meanReturns);
    this.scales = stored.objectives.map((objective) => objective.scale);
    this.domains = this.objectives.map((_, i) => {
      const column = [...this.means, ...this.bestKnown].map((row) => row[i]);
      const [low, high] = [Math.min(...column), Math.max(...column)];
      return high > low ? [low, high] : [low - 0.5 * (Math.abs(low) || 1), low + 0.5 * (Math.abs(low) || 1)];
    });
    this.decoded = new Map();
  }

  extent(i) {
    return this.domains[i][1] - this.domains[i][0];
  }

  scaled(value, i) {
    return (value - this.domains[i][0]) / this.extent(i);
  }

  text(value, i, signed = false) {
    return formatted(value, this.extent(i), signed);
  }

  drive(scenario, k) {
    const key = `${scenario}/${k}`;
    if (!this.decoded.has(key)) {
      const scene = this.scenes[scenario];
      this.decoded.set(key, decodeDrive(scene.drives[k], scene.resolution));
    }
    return this.decoded.get(key);
  }

  initialState() {
    return {
      mode: "weights",
      weights: this.objectives.map(() => 50),
      budget: this.budget && { g_force: this.budget.g_force, jerk: this.budget.jerk },
      picked: 0,
      compared: [],
      scenario: 0,
      ranges: {},
    };
  }
}

/** The number of the front and the state that a link keeps; what is not valid in it is left at its default. */
function stateOfLink(hash, fronts) {
  const values = new URLSearchParams(hash.replace(/^#/, ""));
  const numbers = (name) => (values.get(name) || "").split(",").filter(Boolean).map(Number);
  const below = (name, count) => values.has(name) && Number.isInteger(Number(values.get(name)))
    && Number(values.get(name)) >= 0 && Number(values.get(name)) < count;
  const index = below("front", fronts.length) ? Number(values.get("front")) : 0;
  const front = fronts[index];
  const state = front.initialState();
  const weights = numbers("weights");
  if (weights.length === state.weights.length && weights.every((w) => w >= 0 && w <= 100)) state.weights = weights;
  const budget = numbers("budget");
  if (state.budget && budget.length === 2 && budget.every((limit) => limit >= 0 && limit < Infinity)) {
    state.budget = { g_force: budget[0], jerk: budget[1] };
  }
  const modes = ["weights", ...(state.budget ? ["budget"] : [])];
  if (below("policy", front.size)) {
    state.picked = Number(values.get("policy"));
    modes.push("picked");
  }
  if (modes.includes(values.get("mode"))) state.mode = values.get("mode");
  const compared = numbers("compare").filter((k) => Number.isInteger(k) && k >= 0 && k < front.size);
  state.compared = [...new Set(compared)].slice(0, MOST_COMPARED);
  if (below("scenario", front.scenes.length)) state.scenario = Number(values.get("scenario"));
  for (const text of values.getAll("range")) {
    const [i, low, high] = text.split(",").map(Number);
    if (front.objectives[i] && low <= high) state.ranges[i] = [low, high];
  }
  return { index, state };
}

/** The link of a state: the part of an address from "#" on. */
function linkOfState(index, state) {
  const values = new URLSearchParams({ front: index, mode: state.mode, weights: state.weights.join(",") });
  if (state.budget) values.set("budget", `${state.budget.g_force},${state.budget.jerk}`);
  if (state.mode === "picked") values.set("policy", state.picked);
  if (state.compared.length) values.set("compare", state.compared.join(","));
  if (state.scenario) values.set("scenario", state.scenario);
  for (const [i, [low, high]] of Object.entries(state.ranges)) values.append("range", `${i},${low},${high}`);
  return `#${values.toString().replaceAll("%2C", ",")}`;
}
