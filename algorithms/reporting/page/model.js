// The data of a front, what follows from them, and the link that keeps a choice.

const MOST_COMPARED = 3;

function readData(text) {
  const again = "Write the page again with mo-deepdrive explore.";
  let data;
  try {
    data = JSON.parse(text);
  } catch {
    throw new Refusal(`The data of this page are broken. ${again}`);
  }
  if (data?.format !== FORMAT) {
    throw new Refusal(`The data of this page have format ${String(data?.format)}; its code reads format ${FORMAT}. ${again}`);
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
    const timed = stored.objectives.some(({ key }) => key === "time") || !stored.scenes.length;
    this.seconds = timed ? null : stored.lengths.map((decisions) => decisions / stored.scenes[0].frequency);
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
  /** Take the undiscounted returns, or those with a discount factor; a policy's row has them and, if it is not among them, the time. */
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
  ends(i) { const { way, low, high } = this.axes[i]; return way > 0 ? [low, high] : [high, low]; }
  /** Where a value is along an axis, from 0 for the worst to 1 for the best. */
  scaled(value, i) { const [worst, best] = this.ends(i); return (value - worst) / (best - worst); }
  /** The value at the share of an axis. */
  valueAt(share, i) { const [worst, best] = this.ends(i); return worst + share * (best - worst); }
  text(value, i, signed = false) { return formatted(value, this.axes[i].high - this.axes[i].low, signed); }

  drive(scenario, k) {
    const [key, scene] = [`${scenario}/${k}`, this.scenes[scenario]];
    if (!this.decoded.has(key)) this.decoded.set(key, decodeDrive(scene.drives[k], scene.resolution));
    return this.decoded.get(key);
  }

  /** Equal weights, or, where the policy that they choose hardly arrives, the next one that does; on a scenario of usual length. */
  initialState() {
    const budget = this.budget && { g_force: this.budget.g_force, jerk: this.budget.jerk };
    const values = weightedSums(this.returns, this.scales.map((scale) => weightOf(50, scale)));
    const order = rankPolicies(values, this.means, this.scales);
    const enough = 0.5 * Math.max(...this.success);
    const picked = order.find((k) => this.success[k] >= enough && (k === order[0] || this.dominators[k] < 0)) ?? order[0];
    const unusual = this.scenes.map((_, scenario) => Math.abs(this.drive(scenario, picked).decisions - this.lengths[picked]));
    return { mode: picked === order[0] ? "weights" : "picked", weights: this.objectives.map(() => 50), budget, picked, compared: [],
      scenario: Math.max(unusual.indexOf(Math.min(...unusual)), 0), ranges: {}, returns: 0, dominated: false };
  }
}

/** The number of the front and the state that a link keeps; what is not valid in it is left at its default. */
function stateOfLink(hash, fronts) {
  const values = new URLSearchParams(hash.replace(/^#/, ""));
  const numbers = (name) => (values.get(name) || "").split(",").filter(Boolean).map(Number);
  const isBelow = (value, count) => Number.isInteger(value) && value >= 0 && value < count;
  const below = (name, count, other) => (values.has(name) && isBelow(Number(values.get(name)), count) ? Number(values.get(name)) : other);
  const index = below("front", fronts.length, 0);
  const front = fronts[index];
  const state = front.initialState();
  const [weights, budget] = [numbers("weights"), numbers("budget")];
  if (weights.length === state.weights.length && weights.every((w) => w >= 0 && w <= 100)) state.weights = weights;
  if (state.budget && budget.length === 2 && budget.every((limit) => limit >= 0 && limit < Infinity)) {
    state.budget = { g_force: budget[0], jerk: budget[1] };
  }
  const picked = below("policy", front.size, null);
  state.picked = picked ?? state.picked;
  const modes = ["weights", ...(state.budget ? ["budget"] : []), ...(picked === null ? [] : ["picked"])];
  if (modes.includes(values.get("mode"))) state.mode = values.get("mode");
  state.compared = [...new Set(numbers("compare").filter((k) => isBelow(k, front.size)))].slice(0, MOST_COMPARED);
  state.returns = below("returns", front.measured.length, 0);
  state.dominated = values.has("dominated");
  state.scenario = below("scenario", front.scenes.length, state.scenario);
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
  for (const name of ["returns", "scenario"]) if (state[name]) values.set(name, state[name]);
  if (state.dominated) values.set("dominated", "");
  for (const [i, [low, high]] of Object.entries(state.ranges)) values.append("range", `${i},${low},${high}`);
  return `#${values.toString().replaceAll("%2C", ",")}`;
}
