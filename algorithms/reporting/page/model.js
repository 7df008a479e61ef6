// The data of the page, what follows from them, and the link that keeps a choice.

const FORMAT = /* format */ 0;
const MOST_COMPARED = 3;
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

/** One front with what follows from its data. */
class FrontModel {
  constructor({ returns, ...stored }) {
    Object.assign(this, stored);
    this.measured = returns;
    this.size = stored.success.length;
    this.scales = stored.objectives.map((objective) => objective.scale);
    this.undiscounted = returns[0].episodes.map(meanReturns);
    // Of fronts without the time among their objectives: how long the drives are.
    const timed = stored.objectives.some(({ key }) => key === "time");
    this.seconds = timed || !stored.scenes.length ? null
      : stored.lengths.map((decisions) => decisions / stored.scenes[0].frequency);
    this.vehicles = stored.scenes[0]?.drives[0].vehicles.length ?? 1;
    this.vehicle = 0;
    this.decoded = new Map();
    this.take(0);
  }

  /** The axes on the page: of several vehicles those of the one that is shown, and the time. */
  get columns() {
    const others = (key) => key?.startsWith("vehicle_") && !key.startsWith(`vehicle_${this.vehicle}/`);
    return this.axes.map((_, i) => i).filter((i) => this.vehicles < 2 || !others(this.objectives[i]?.key));
  }

  /**
   * Take the returns of number `which` of those that were measured: undiscounted, or with a discount factor.
   *
   * The policies have a row of values each, one per axis: the objectives and, if it is not among them, the time.
   */
  take(which) {
    const { gamma, episodes, bestKnown } = this.measured[which];
    Object.assign(this, { gamma, returns: episodes, bestKnown, means: episodes.map(meanReturns) });
    this.rows = this.means.map((row, k) => (this.seconds ? [...row, this.seconds[k]] : row));
    const named = [...this.objectives.map(({ name, unit }) => ({ name, unit, way: 1 })), { name: "time", unit: "s", way: -1 }];
    this.axes = named.slice(0, this.rows[0]?.length).map((axis, i) => {
      const column = [...this.rows, ...bestKnown].map((row) => row[i]).filter((value) => value !== undefined);
      const [low, high] = [Math.min(...column), Math.max(...column)];
      const margin = high > low ? 0 : 0.5 * (Math.abs(low) || 1);
      return { ...axis, low: low - margin, high: high + margin };
    });
    this.maximised = this.rows.map((row) => row.map((value, i) => this.axes[i].way * value));
    this.dominators = dominators(this.maximised);
  }

  extent(i) {
    return this.axes[i].high - this.axes[i].low;
  }

  /** Where a value is along an axis, from 0 for the worst to 1 for the best. */
  scaled(value, i) {
    const { way, low, high } = this.axes[i];
    return (way > 0 ? value - low : high - value) / (high - low);
  }

  /** The value at the share of an axis. */
  valueAt(share, i) {
    const { way, low, high } = this.axes[i];
    return way > 0 ? low + share * (high - low) : high - share * (high - low);
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
      returns: 0,
      dominated: false,
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
  if (below("returns", front.measured.length)) state.returns = Number(values.get("returns"));
  state.dominated = values.has("dominated");
  if (below("scenario", front.scenes.length)) state.scenario = Number(values.get("scenario"));
  for (const text of values.getAll("range")) {
    const [i, low, high] = text.split(",").map(Number);
    if (front.axes[i] && low <= high) state.ranges[i] = [low, high];
  }
  return { index, state };
}

/** The link of a state: the part of an address from "#" on. */
function linkOfState(index, state) {
  const values = new URLSearchParams({ front: index, mode: state.mode, weights: state.weights.join(",") });
  if (state.budget) values.set("budget", `${state.budget.g_force},${state.budget.jerk}`);
  if (state.mode === "picked") values.set("policy", state.picked);
  if (state.compared.length) values.set("compare", state.compared.join(","));
  if (state.returns) values.set("returns", state.returns);
  if (state.dominated) values.set("dominated", "");
  if (state.scenario) values.set("scenario", state.scenario);
  for (const [i, [low, high]] of Object.entries(state.ranges)) values.append("range", `${i},${low},${high}`);
  return `#${values.toString().replaceAll("%2C", ",")}`;
}
