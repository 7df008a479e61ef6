// The page: its state, the link that keeps it, and what is shown of it.

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

class Explorer {
  constructor(fronts) {
    this.fronts = fronts.map((front) => new FrontModel(front));
    this.map = new DriveMap(byId("map"));
    this.player = new Player((step) => this.showStep(step));
    this.step = 0;
    this.charts = [];
    this.sorting = null;
    this.wire();
    this.read(location.hash);
    this.showFront();
  }

  get front() {
    return this.fronts[this.index];
  }

  // ------------------------------------------------------------------------------------------------------- the link

  /** Take over the state of a link; what is not valid in it is left at its default. */
  read(hash) {
    const values = new URLSearchParams(hash.replace(/^#/, ""));
    const numbers = (name) => (values.get(name) || "").split(",").filter(Boolean).map(Number);
    const isPolicy = (k) => Number.isInteger(k) && k >= 0 && k < this.front.size;
    const front = Number(values.get("front"));
    this.index = Number.isInteger(front) && front >= 0 && front < this.fronts.length ? front : 0;
    this.state = this.front.initialState();
    const { state } = this;
    const weights = numbers("weights");
    if (weights.length === state.weights.length && weights.every((w) => w >= 0 && w <= 100)) state.weights = weights;
    const budget = numbers("budget");
    if (state.budget && budget.length === 2 && budget.every((limit) => limit >= 0 && limit < Infinity)) {
      [state.budget.g_force, state.budget.jerk] = budget;
    }
    const picked = Number(values.get("policy"));
    if (values.has("policy") && isPolicy(picked)) state.picked = picked;
    const modes = ["weights", ...(state.budget ? ["budget"] : []), ...(values.has("policy") && isPolicy(picked) ? ["picked"] : [])];
    if (modes.includes(values.get("mode"))) state.mode = values.get("mode");
    state.compared = [...new Set(numbers("compare").filter(isPolicy))].slice(0, MOST_COMPARED);
    const scenario = Number(values.get("scenario"));
    if (Number.isInteger(scenario) && scenario >= 0 && scenario < this.front.scenes.length) state.scenario = scenario;
    for (const text of values.getAll("range")) {
      const [i, low, high] = text.split(",").map(Number);
      if (this.front.objectives[i] && low <= high) state.ranges[i] = [low, high];
    }
  }

  /** Keep the state in the address of the page. */
  write() {
    const { state } = this;
    const values = new URLSearchParams({ front: this.index, mode: state.mode, weights: state.weights.join(",") });
    if (state.budget) values.set("budget", `${state.budget.g_force},${state.budget.jerk}`);
    if (state.mode === "picked") values.set("policy", state.picked);
    if (state.compared.length) values.set("compare", state.compared.join(","));
    if (state.scenario) values.set("scenario", state.scenario);
    for (const [i, [low, high]] of Object.entries(state.ranges)) values.append("range", `${i},${low},${high}`);
    this.hash = `#${values.toString().replaceAll("%2C", ",")}`;
    history.replaceState(null, "", this.hash);
  }

  // ----------------------------------------------------------------------------------------------------- the choice

  weightsOf() {
    return this.state.weights.map((importance, i) => weightOf(importance, this.front.scales[i]));
  }

  /** Policies in the order of the preference; of a policy picked by hand, of its returns as the target. */
  order() {
    const { front, state } = this;
    let values;
    if (state.mode === "weights") values = weightedSums(front.returns, this.weightsOf());
    else if (state.mode === "budget") {
      values = budgetUtilities(front.returns, front.objectives, { ...front.budget, ...state.budget });
    } else values = targetCloseness(front.means, front.means[state.picked], front.scales);
    return rankPolicies(values, front.means, front.scales);
  }

  chosen() {
    return this.state.mode === "picked" ? this.state.picked : this.order()[0];
  }

  shownPolicies() {
    const chosen = this.chosen();
    return [chosen, ...this.state.compared.filter((k) => k !== chosen)].slice(0, 1 + MOST_COMPARED);
  }

  kept() {
    const ranges = Object.entries(this.state.ranges);
    return this.front.means.map((row) => ranges.every(([i, [low, high]]) => row[i] >= low && row[i] <= high));
  }

  command() {
    const { front, state } = this;
    const named = (values) => values.map(([key, value]) => `${key}=${value}`).join(" ");
    const keys = front.objectives.map((objective) => objective.key);
    let preference;
    if (state.mode === "weights") {
      const weights = this.weightsOf().map((w, i) => [keys[i], w]);
      const counting = weights.filter(([, w]) => w > 0);
      preference = `--weights ${named(counting.length ? counting : weights)}`;
    } else if (state.mode === "budget") {
      const { g_force: g, jerk } = state.budget;
      preference = `--utility ${front.budget.name} --arguments '{g_force: ${g}, jerk: ${jerk}}'`;
    } else preference = `--target ${named(front.means[state.picked].map((value, i) => [keys[i], value]))}`;
    return front.command.replace("{preference}", () => preference).replace("{policy}", front.numbers[this.chosen()]);
  }

  // ------------------------------------------------------------------------------------------------ what is on the page

  wire() {
    const change = (id, event, action) => byId(id).addEventListener(event, action);
    byId("front-choice").hidden = this.fronts.length < 2;
    byId("front-select").append(...this.fronts.map((front, i) => element("option", { value: i }, front.title)));
    change("front-select", "change", (event) => {
      this.read(`#front=${event.target.value}`);
      this.showFront();
    });
    change("theme", "change", (event) => setTheme(event.target.value));
    for (const input of document.querySelectorAll("input[name=mode]")) {
      input.addEventListener("change", () => this.update({ mode: input.value }));
    }
    change("reset", "click", () => {
      this.state = this.front.initialState();
      this.showFront();
    });
    change("copy-command", "click", () => copy(byId("command").value, "command"));
    change("copy-link", "click", () => copy(location.href, "link"));
    change("command", "focus", (event) => event.target.select());
    change("play", "click", () => this.togglePlay());
    change("time", "input", (event) => {
      this.stop();
      this.showStep(Number(event.target.value));
    });
    change("speed", "change", (event) => (this.player.speed = Number(event.target.value)));
    change("scenario", "change", (event) => this.update({ scenario: Number(event.target.value) }));
    window.addEventListener("hashchange", () => {
      if (location.hash === this.hash) return;
      this.read(location.hash);
      this.showFront();
    });
    const observer = new ResizeObserver(() => {
      const width = byId("parallel").clientWidth;
      if (width === this.width || this.front.size === 0) return;
      this.width = width;
      this.drawParallel();
      this.drawCharts();
    });
    observer.observe(byId("parallel"));
  }

  update(changes) {
    Object.assign(this.state, changes);
    this.refresh();
  }

  /** Show another front, or the state of a link. */
  showFront() {
    const { front } = this;
    this.stop();
    byId("front-select").value = this.index;
    byId("title").textContent = front.title;
    byId("content").hidden = front.size === 0;
    showMessage(front.size === 0 ? `The front “${front.title}” has no policies.`
      : front.size === 1 ? "This front has one policy: there is nothing to choose between." : "");
    if (front.size === 0) return;
    byId("note").textContent = front.note;
    byId("no-drive").hidden = front.scenes.length > 0;
    byId("drives").hidden = front.scenes.length === 0;
    byId("budget-mode").hidden = !front.budget;
    byId("modes").hidden = !front.budget;
    byId("scenario-choice").hidden = front.scenes.length < 2;
    byId("scenario").replaceChildren(
      ...front.scenes.map((scene, i) => element("option", { value: i }, `${i + 1} (seed ${scene.seed})`)));
    this.makeSliders();
    this.makeRanges();
    this.width = byId("parallel").clientWidth;
    this.drawParallel();
    this.step = 0;
    this.refresh();
  }

  slider({ label, value, max, step, text, change }) {
    const output = element("output", {}, text(value));
    const input = element("input", { type: "range", min: 0, max, step, value, "aria-valuetext": text(value),
      oninput: () => {
        output.textContent = text(Number(input.value));
        input.setAttribute("aria-valuetext", output.textContent);
        change(Number(input.value));
      } });
    return element("label", { class: "slider" }, element("span", {}, label), output, input);
  }

  makeSliders() {
    const { front, state } = this;
    byId("weights").replaceChildren(...front.objectives.map((objective, i) => this.slider({
      label: objective.name,
      value: state.weights[i],
      max: 100,
      step: 1,
      text: (importance) => `weight ${weightOf(importance, objective.scale)}`,
      change: (importance) => this.update({ mode: "weights", weights: state.weights.with(i, importance) }),
    })));
    byId("budgets").replaceChildren(...(front.budget ? ["g_force", "jerk"] : []).map((key) => {
      const i = front.objectives.findIndex((objective) => objective.key === key);
      const objective = front.objectives[i];
      const most = Math.max(2 * front.budget[key], ...front.means.map((row) => row[i] * objective.sign));
      const step = 10 ** Math.floor(Math.log10(most / 50));
      return this.slider({
        label: `${objective.name} free up to`,
        value: state.budget[key],
        max: Math.ceil(most / step) * step,
        step,
        text: (limit) => withUnit(String(limit), objective.unit),
        change: (limit) => this.update({ mode: "budget", budget: { ...this.state.budget, [key]: limit } }),
      });
    }));
  }

  makeRanges() {
    const { front } = this;
    byId("ranges").replaceChildren(...front.objectives.map((objective, i) => {
      const limit = (end, name) => element("input", { type: "number", step: "any", "data-range": `${i}/${end}`,
        "aria-label": `${name} ${titled(objective)}`, onchange: (event) => {
          const range = [...(this.state.ranges[i] ?? [-Infinity, Infinity])];
          range[end] = event.target.value === "" ? [-Infinity, Infinity][end] : Number(event.target.value);
          this.setRange(i, range);
        } });
      return element("div", { class: "range", role: "group", "aria-label": titled(objective) },
        element("span", {}, titled(objective)), limit(0, "least"), "to", limit(1, "most"));
    }));
  }

  setRange(i, range) {
    const ranges = { ...this.state.ranges };
    delete ranges[i];
    const whole = !range || (range[0] === -Infinity && range[1] === Infinity);
    if (!whole && range[0] <= range[1]) ranges[i] = range;
    this.update({ ranges });
  }

  drawParallel() {
    const { front } = this;
    this.parallel?.finalize();
    const axes = front.objectives.map((objective, i) => ({
      axis: i, title: titled(objective), worst: front.text(front.domains[i][0], i), best: front.text(front.domains[i][1], i) }));
    const rows = (means) => means.flatMap((row, policy) => row.map((value, axis) => ({
      policy, axis, value: front.scaled(value, axis) })));
    this.axes = axes;
    const view = makeView(parallelSpec(axes, this.width), byId("parallel"),
      `Parallel coordinates of ${front.size} policies; the table of all policies has their numbers`);
    view.data("bestKnown", rows(front.bestKnown)).data("learnt", rows(front.means));
    view.addSignalListener("picked", (_, picked) => this.update({ mode: "picked", picked: picked.policy }));
    view.addSignalListener("brushing", (_, brushing) => {
      const [low, high] = front.domains[brushing.axis];
      const [from, to] = [brushing.from, brushing.to].sort((a, b) => a - b).map((share) => low + share * (high - low));
      const digits = (value) => Number(value.toPrecision(5));
      this.setRange(brushing.axis, Math.abs(brushing.from - brushing.to) < 0.01 ? null : [digits(from), digits(to)]);
    });
    this.parallel = view;
    this.showParallel();
  }

  showParallel() {
    const clamped = (value, i) => Math.min(Math.max(this.front.scaled(value, i), 0), 1);
    const axes = this.axes.map((axis) => {
      const range = this.state.ranges[axis.axis];
      return range ? { ...axis, low: clamped(range[0], axis.axis), high: clamped(range[1], axis.axis) } : { ...axis };
    });
    this.parallel.data("axes", axes).signal("chosen", this.shownPolicies()).signal("kept", this.kept()).run();
  }

  refresh() {
    this.write();
    this.showChoice();
    this.showParallel();
    this.showLegend();
    this.showTrades();
    this.showTable();
    this.showDrives();
  }

  showChoice() {
    const { front, state } = this;
    const chosen = this.chosen();
    byId("weights").hidden = state.mode === "budget";
    byId("budgets").hidden = state.mode !== "budget";
    for (const input of document.querySelectorAll("input[name=mode]")) input.checked = input.value === state.mode;
    const heading = `Policy ${front.numbers[chosen]}`;
    if (byId("chosen").textContent !== heading) byId("chosen").textContent = heading;
    byId("chosen").dataset.policy = chosen;
    const first = this.order()[0];
    byId("why").textContent = {
      weights: "It has the greatest weighted sum of mean returns. A weight counts per unit of the return.",
      budget: "It has the greatest expected utility: arriving counts 10, a metre 0.1; g-force and jerk beyond the "
        + "budgets cost 2 and 0.05 per unit.",
      picked: first === chosen ? "Chosen by hand; a slider chooses by preference again."
        : `Chosen by hand. Policy ${front.numbers[first]} is at least as good in every objective, so the command chooses it.`,
    }[state.mode];
    const success = front.success[chosen];
    byId("values").replaceChildren(
      ...front.objectives.flatMap((objective, i) => [element("dt", {}, objective.name),
        element("dd", {}, withUnit(front.text(front.means[chosen][i], i), objective.unit))]),
      ...(success === null ? [] : [element("dt", {}, "arrivals"), element("dd", {}, percent(success))]));
    byId("command").value = this.command();
    byId("command-label").textContent = front.command.includes("{preference}") ? "Evaluate it again" : "Its actions";
    byId("copied").textContent = "";
  }

  showLegend() {
    const { front } = this;
    const entries = this.shownPolicies().map((k, place) =>
      element("span", {}, swatch(place), `policy ${front.numbers[k]}${place ? "" : " (chosen)"}`));
    if (front.bestKnown.length) entries.push(element("span", {}, element("span", { class: "swatch",
      style: "border-color: var(--faint); border-top-width: 2px" }), `best known (${front.bestKnown.length} policies)`));
    byId("parallel-legend").replaceChildren(...entries);
    const kept = this.kept();
    const count = kept.filter(Boolean).length;
    const outside = kept[this.chosen()] ? "" : "; the chosen policy is outside of the ranges";
    byId("kept").textContent = count === front.size ? "" : `${count} of ${front.size} policies are in the ranges${outside}.`;
    for (const input of document.querySelectorAll("[data-range]")) {
      const [i, end] = input.dataset.range.split("/").map(Number);
      const value = this.state.ranges[i]?.[end];
      input.value = Number.isFinite(value) ? value : "";
    }
  }

  pickButton(k) {
    return element("button", { type: "button", "aria-label": `choose policy ${this.front.numbers[k]}`,
      onclick: () => this.update({ mode: "picked", picked: k }) }, "Choose");
  }

  compareBox(k) {
    const on = this.state.compared.includes(k);
    const full = !on && this.state.compared.length >= MOST_COMPARED;
    return element("input", { type: "checkbox", checked: on, disabled: full || k === this.chosen(),
      "data-compare": k, "aria-label": `compare policy ${this.front.numbers[k]}`, onchange: (event) => {
        const others = this.state.compared.filter((each) => each !== k);
        this.update({ compared: event.target.checked ? [...others, k] : others });
        document.querySelector(`#${event.target.closest("table")?.id || "policies"} [data-compare="${k}"]`)?.focus();
      } });
  }

  showTrades() {
    const { front } = this;
    const chosen = this.chosen();
    const found = alternatives(front.means, chosen);
    byId("trades").closest("section").hidden = front.size < 2;
    const difference = (k, i) => {
      const step = front.means[k][i] - front.means[chosen][i];
      const text = front.text(step, i, true);
      if (Number(text.replace("−", "-")) === 0) return element("td", {}, "0");
      const better = step > 0;
      return element("td", { class: better ? "better" : "worse" }, `${better ? "▲" : "▼"} ${text}`);
    };
    byId("trades").replaceChildren(
      element("thead", {}, element("tr", {}, ...["For", "Policy", ...front.objectives.map(titled), "", "Compare"].map(
        (text) => element("th", { scope: "col" }, text)))),
      element("tbody", {}, ...found.map(({ k, objective }) => element("tr", {},
        element("th", { scope: "row" }, objective === null ? "a small change" : `better ${front.objectives[objective].name}`),
        element("td", {}, String(front.numbers[k])),
        ...front.objectives.map((_, i) => difference(k, i)),
        element("td", {}, this.pickButton(k)), element("td", {}, this.compareBox(k))))));
  }

  showTable() {
    const { front } = this;
    const kept = this.kept();
    const chosen = this.chosen();
    const arrivals = front.success.every((share) => share !== null);
    const columns = [
      { name: "Policy", of: (k) => front.numbers[k], text: (k) => String(front.numbers[k]) },
      ...front.objectives.map((objective, i) => ({
        name: titled(objective), of: (k) => front.means[k][i], text: (k) => front.text(front.means[k][i], i) })),
      ...(arrivals ? [{ name: "arrivals", of: (k) => front.success[k], text: (k) => percent(front.success[k]) }] : []),
      { name: "decisions", of: (k) => front.lengths[k], text: (k) => front.lengths[k].toFixed(0) },
    ];
    const order = front.means.map((_, k) => k);
    if (this.sorting && columns[this.sorting.column]) {
      const { of } = columns[this.sorting.column];
      order.sort((a, b) => this.sorting.way * (of(a) - of(b)) || a - b);
    }
    const sort = (column) => {
      this.sorting = { column, way: this.sorting?.column === column ? -this.sorting.way : -1 };
      this.showTable();
      byId("policies").querySelectorAll("thead button")[column].focus();
    };
    const heading = ({ name }, column) => {
      const way = this.sorting?.column === column ? this.sorting.way : 0;
      return element("th", { scope: "col", "aria-sort": ["descending", "none", "ascending"][way + 1] },
        element("button", { type: "button", onclick: () => sort(column) }, `${name}${["\u00a0↓", "", "\u00a0↑"][way + 1]}`));
    };
    byId("policies").replaceChildren(
      element("thead", {}, element("tr", {}, ...columns.map(heading), element("th", {}, ""),
        element("th", { scope: "col" }, "Compare"))),
      element("tbody", {}, ...order.filter((k) => kept[k] || k === chosen).map((k) => element("tr", {
        "data-policy": k, class: [k === chosen ? "chosen" : "", kept[k] ? "" : "out"].join(" ").trim() },
        ...columns.map(({ text }, i) => (i ? element("td", {}, text(k)) : element("th", { scope: "row" }, text(k)))),
        element("td", {}, this.pickButton(k)), element("td", {}, this.compareBox(k))))));
  }

  // ------------------------------------------------------------------------------------------------------ the drives

  showDrives() {
    const { front, state } = this;
    if (!front.scenes.length) return;
    byId("scenario").value = state.scenario;
    this.scene = front.scenes[state.scenario];
    this.shown = this.shownPolicies().map((k) => ({
      label: String(front.numbers[k]), drive: front.drive(state.scenario, k) }));
    this.last = Math.max(...this.shown.map(({ drive }) => drive.decisions));
    byId("time").max = this.last;
    this.map.show(this.scene, this.shown);
    this.drawCharts();
    this.showStep(Math.min(this.step, this.last));
  }

  drawCharts() {
    if (!this.front.scenes.length || !this.shown) return;
    for (const view of this.charts) view.finalize();
    const host = byId("charts");
    const width = host.clientWidth;
    const readings = [["g_force", "g-force (g)"], ["jerk", "jerk (m/s³)"]];
    host.replaceChildren(...readings.map(([name]) => element("div", { "data-reading": name })));
    const names = this.shown.map(({ label }) => `policy ${label}`).join(", ");
    this.charts = readings.map(([name, title], i) => {
      const view = makeView(timeSpec(title, width), host.children[i], `${title} over time of ${names}`);
      const rows = this.shown.flatMap(({ drive }, place) => drive[name].map((value, step) => ({
        place, time: step / this.scene.frequency, value })));
      return view.data("readings", rows).signal("now", this.step / this.scene.frequency).run();
    });
  }

  showStep(step) {
    this.step = step;
    const seconds = (count) => `${(count / this.scene.frequency).toFixed(1)} s`;
    byId("time").value = step;
    byId("time").setAttribute("aria-valuetext", seconds(step));
    byId("clock").textContent = `${seconds(step)} of ${seconds(this.last)}`;
    this.map.move(step);
    for (const view of this.charts) view.signal("now", step / this.scene.frequency).run();
    const cells = this.shown.map(({ label, drive }, place) => {
      const now = Math.min(step, drive.decisions);
      const state = step >= drive.decisions ? drive.end.replaceAll("_", " ") : "driving";
      return element("tr", {}, element("th", { scope: "row" }, swatch(place), `policy ${label}`),
        ...[drive.speed[now].toFixed(2), drive.g_force[now].toFixed(3), drive.jerk[now].toFixed(1), state].map((text) =>
          element("td", {}, text)));
    });
    byId("readings").replaceChildren(element("table", {},
      element("thead", {}, element("tr", {}, ...["", "speed (m/s)", "g-force (g)", "jerk (m/s³)", ""].map((text) =>
        element("th", { scope: "col" }, text)))), element("tbody", {}, ...cells)));
    if (!this.player.playing) this.showPlaying(false);
  }

  togglePlay() {
    if (this.player.playing) {
      this.stop();
      return;
    }
    this.player.play(this.step, this.last, this.scene.frequency);
    this.showPlaying(true);
  }

  stop() {
    this.player.stop();
    this.showPlaying(false);
  }

  showPlaying(playing) {
    byId("play").textContent = playing ? "Pause" : "Play";
    byId("play").setAttribute("aria-pressed", playing);
  }
}

const percent = (share) => `${(100 * share).toFixed(0)}%`;

/** A piece of the line of the policy at a place: its colour and its dashes. */
function swatch(place) {
  const line = svg("line", { x1: 0, y1: 4, x2: 26, y2: 4, stroke: series(place), "stroke-width": 3.5,
    "stroke-dasharray": DASHES[place].join(" ") });
  return svg("svg", { width: 32, height: 8, "aria-hidden": "true" }, line);
}

async function copy(text, what) {
  try {
    await navigator.clipboard.writeText(text);
    byId("copied").textContent = `The ${what} is copied.`;
  } catch {
    byId("copied").textContent = `The browser does not allow to copy; the ${what} is: ${text}`;
  }
}

function setTheme(theme) {
  const dark = theme === "dark" || (theme === "auto" && matchMedia("(prefers-color-scheme: dark)").matches);
  document.documentElement.dataset.theme = dark ? "dark" : "light";
}

function showMessage(text) {
  byId("message").textContent = text;
  byId("message").hidden = !text;
}

matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => setTheme(byId("theme").value));
setTheme("auto");
try {
  const fronts = readData(byId("data").textContent);
  byId("content").hidden = false;
  new Explorer(fronts);
} catch (error) {
  byId("content").hidden = true;
  if (!(error instanceof Refusal)) console.error(error);
  showMessage(error instanceof Refusal ? error.message : `This page cannot be shown: ${error.message}`);
}
