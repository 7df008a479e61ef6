// The explorer: its state, and what shows it.

class Explorer {
  constructor(fronts) {
    this.fronts = fronts.map((front) => new FrontModel(front));
    this.map = new DriveMap(byId("map"));
    this.player = new Player((step) => this.showStep(step));
    Object.assign(this, { step: 0, rules: [], sorting: null });
    this.parallel = new Parallel(byId("parallel"), (picked) => this.update({ mode: "picked", picked }), (column, from, to) => {
      const axis = this.front.columns[column];
      const ends = [from, to].map((share) => Number(this.front.valueAt(share, axis).toPrecision(5)));
      this.setRange(axis, Math.abs(from - to) < 0.01 ? null : [Math.min(...ends), Math.max(...ends)]);
    });
    this.wire();
    this.read(location.hash);
    this.showFront();
  }

  get front() { return this.fronts[this.index]; }
  weightsOf() { return this.state.weights.map((importance, i) => weightOf(importance, this.front.scales[i])); }
  /** Policies in the order of the preference; of a policy picked by hand, of its returns as the target. */
  order() {
    const { front, state } = this;
    const values = {
      weights: () => weightedSums(front.returns, this.weightsOf()),
      budget: () => budgetUtilities(front.returns, front.objectives, { ...front.budget, ...state.budget }),
      picked: () => targetCloseness(front.means, front.means[state.picked], front.scales) }[state.mode]();
    return rankPolicies(values, front.means, front.scales);
  }

  chosen() { return this.state.mode === "picked" ? this.state.picked : this.order()[0]; }

  shownPolicies() {
    const chosen = this.chosen();
    return [chosen, ...this.state.compared.filter((k) => k !== chosen)].slice(0, 1 + MOST_COMPARED);
  }
  /** Whether each policy is drawn and listed: all of them, or those that no other one dominates. */
  listed() { return this.front.dominators.map((other) => this.state.dominated || other < 0); }

  inRanges(k) {
    const inside = (value, [low, high]) => value >= low && value <= high;
    return Object.entries(this.state.ranges).every(([i, range]) => inside(this.front.rows[k][i], range));
  }
  /** Whether each policy is listed and in the ranges. */
  kept() { return this.listed().map((listed, k) => listed && this.inRanges(k)); }

  command() {
    const { front, state } = this;
    const named = (values) => values.map((value, i) => [front.objectives[i].key, value]);
    const written = (pairs) => pairs.map(([key, value]) => `${key}=${value}`).join(" ");
    const weights = named(this.weightsOf());
    const counting = weights.filter(([, w]) => w > 0);
    const { g_force: g, jerk } = state.budget ?? {};
    let preference = { weights: `--weights ${written(counting.length ? counting : weights)}`,
      budget: `--utility ${front.budget?.name} --arguments '{g_force: ${g}, jerk: ${jerk}}'`,
      picked: `--target ${written(named(front.undiscounted[state.picked]))}` }[state.mode];
    // The command chooses by undiscounted returns, so it is told the policy where others are shown.
    if (front.gamma < 1) preference += ` --policy ${front.numbers[this.chosen()]}`;
    return front.command.replace("{preference}", () => preference).replace("{policy}", front.numbers[this.chosen()]);
  }

  wire() {
    hide({ "front-choice": this.fronts.length < 2 });
    fill("front-select", options(this.fronts.map(({ title }) => title)));
    const actions = {
      "front-select": ({ value }) => { this.read(`#front=${value}`); this.showFront(); },
      returns: ({ value }) => { Object.assign(this.state, { returns: Number(value), ranges: {} }); this.showFront(); },
      dominated: ({ checked }) => this.update({ dominated: checked }), modes: ({ value }) => this.update({ mode: value }),
      reset: () => { this.state = this.front.initialState(); this.showFront(); },
      "copy-command": () => copy(byId("command").value, "command", byId("copied")),
      "copy-link": () => copy(location.href.split("#")[0] + this.hash, "link", byId("copied")), play: () => this.togglePlay(),
      speed: ({ value }) => (this.player.speed = Number(value)), scenario: ({ value }) => this.update({ scenario: Number(value) }),
      vehicle: ({ value }) => {
        const { step } = this;
        this.front.vehicle = Number(value);
        this.showFront();
        this.showStep(step);
      }, };
    for (const [id, action] of Object.entries(actions)) on(id, ({ target }) => action(target));
    byId("command").addEventListener("focus", ({ target }) => target.select());
    byId("time").addEventListener("input", ({ target }) => { this.stop(); this.showStep(Number(target.value)); });
    window.addEventListener("hashchange", () => {
      if (location.hash === this.hash || (byId("stage") && !location.hash.startsWith("#front="))) return;
      this.read(location.hash);
      this.showFront();
    });
    new ResizeObserver(() => {
      const width = byId("parallel").clientWidth;
      if (width === this.width || width === 0 || this.front.size === 0) return;
      this.drawParallel();
      this.drawTimes();
    }).observe(byId("parallel"));
  }
  /** Take over the state of a link. */
  read(hash) { ({ index: this.index, state: this.state } = stateOfLink(hash, this.fronts)); }
  /** Change parts of the state. */
  update(changes) { Object.assign(this.state, changes); this.refresh(); }
  /** Show another front, or the state of a link. */
  showFront() {
    const { front, state } = this;
    front.take(state.returns);
    this.stop();
    hide({ title: this.fronts.length > 1, content: front.size === 0, "returns-choice": front.measured.length < 2,
      "no-drive": front.scenes.length > 0, drives: front.scenes.length === 0, "budget-mode": !front.budget, modes: !front.budget,
      "scenario-choice": front.scenes.length < 2, "vehicle-choice": front.vehicles < 2 });
    showMessage(front.size === 0 ? `The front “${front.title}” has no policies.`
      : front.size === 1 ? "This front has one policy: there is nothing to choose between." : "");
    if (front.size === 0) return;
    say({ title: front.title, note: front.note, sums: front.gamma === 1 ? "undiscounted sums over a drive"
      : `sums over a drive, discounted by γ = ${front.gamma} per decision` });
    fill("returns", options(front.measured.map(({ gamma }) => (gamma === 1 ? "undiscounted" : `discounted, γ = ${gamma}`))));
    fill("scenario", options(front.scenes.map((scene, i) => `${i + 1} (seed ${scene.seed})`)));
    fill("vehicle", options(times(front.vehicles, String)));
    const taken = { "front-select": this.index, returns: state.returns, vehicle: front.vehicle };
    for (const [id, value] of Object.entries(taken)) byId(id).value = value;
    this.makeSliders();
    this.makeRanges();
    this.drawParallel();
    this.step = 0;
    this.drawn = "";
    this.refresh();
  }

  setRange(i, range) {
    const { [i]: _, ...ranges } = this.state.ranges;
    const isOne = range && range[0] <= range[1] && range.some(Number.isFinite);
    this.update({ ranges: isOne ? { ...ranges, [i]: range } : ranges });
  }

  drawParallel() {
    const { front } = this;
    this.width = byId("parallel").clientWidth;
    const axes = front.columns.map((i) => ({ title: titled(front.axes[i]), worst: front.text(front.valueAt(0, i), i),
      best: front.text(front.valueAt(1, i), i) }));
    const shares = (row) => front.columns.filter((i) => i < row.length).map((i) => front.scaled(row[i], i));
    this.parallel.draw(axes, front.rows.map(shares), front.bestKnown.map(shares));
    this.showParallel();
  }

  showParallel() {
    const share = (value, axis) => Math.min(Math.max(this.front.scaled(value, axis), 0), 1);
    const ranges = this.front.columns.flatMap((axis, column) => {
      const [low, high] = (this.state.ranges[axis] ?? []).map((value) => share(value, axis));
      return low === undefined ? [] : [{ axis: column, low, high }];
    });
    this.parallel.show({ ranges, listed: this.listed(), kept: this.kept(), shown: this.shownPolicies() });
  }

  refresh() {
    this.hash = linkOfState(this.index, this.state);
    clearTimeout(this.writing); // browsers limit how often a page may change its address
    this.writing = setTimeout(() => history.replaceState(null, "", this.hash), 200);
    this.showChoice();
    // A slider changes the choice now and then only, and drawing takes a while.
    const { compared, ranges, scenario, dominated } = this.state;
    const drawn = JSON.stringify([this.chosen(), compared, ranges, scenario, dominated]);
    if (drawn === this.drawn) return;
    this.drawn = drawn;
    this.showLegend();
    this.showTrades();
    this.showTable();
    this.showParallel();
    this.showDrives();
  }

  makeSliders() {
    const { front, state } = this;
    const shown = front.columns.filter((i) => i < front.objectives.length).map((i) => [front.objectives[i], i]);
    fill("weights", shown.map(([objective, i]) => slider({
      id: `weight-${i}`, label: objective.name, value: state.weights[i], max: 100, step: 1,
      text: (importance) => `weight ${weightOf(importance, objective.scale)}`,
      change: (importance) => this.update({ mode: "weights", weights: state.weights.with(i, importance) }) })));
    fill("budgets", Object.keys(front.budget?.excessPrices ?? {}).map((key) => {
      const i = front.objectives.findIndex((objective) => objective.key === key);
      const objective = front.objectives[i];
      const most = Math.max(2 * front.budget[key], ...front.means.map((row) => row[i] * objective.sign));
      const step = 10 ** Math.floor(Math.log10(most / 50));
      return slider({
        id: `budget-${i}`, label: `${objective.name} free up to`, value: state.budget[key], max: Math.ceil(most / step) * step, step,
        text: (limit) => withUnit(String(limit), objective.unit),
        change: (limit) => this.update({ mode: "budget", budget: { ...this.state.budget, [key]: limit } }) });
    }));
  }

  makeRanges() {
    const { front } = this;
    fill("ranges", front.columns.map((i) => {
      const name = titled(front.axes[i]);
      const limit = (end, which) => element("input", { type: "number", step: "any", "data-range": `${i}/${end}`,
        "aria-label": `${which} ${name}`, onchange: ({ target }) => {
          const range = [...(this.state.ranges[i] ?? [-Infinity, Infinity])];
          range[end] = target.value === "" ? [-Infinity, Infinity][end] : Number(target.value);
          this.setRange(i, range);
        } });
      return element("div", { class: "range", role: "group", "aria-label": name },
        element("span", {}, name), limit(0, "least"), "to", limit(1, "most"));
    }));
  }

  showChoice() {
    const { front, state } = this;
    const chosen = this.chosen();
    hide({ weights: state.mode === "budget", budgets: state.mode !== "budget" });
    for (const input of document.querySelectorAll("input[name=mode]")) input.checked = input.value === state.mode;
    const heading = `Policy ${front.numbers[chosen]}`;
    if (byId("chosen").textContent !== heading) say({ chosen: heading });
    byId("chosen").dataset.policy = chosen;
    const first = this.order()[0];
    let why = {
      weights: () => "It has the greatest weighted sum of mean returns. A weight counts per unit of the return."
        + (front.gamma < 1 ? " The command scores it by undiscounted returns." : ""), budget: () => front.budget.rule,
      picked: () => (first === chosen || front.gamma < 1 ? "Chosen by hand; a slider chooses by preference again."
        : `Chosen by hand. The command chooses policy ${front.numbers[first]}, which is at least as good in every objective.`),
    }[state.mode]();
    const other = front.dominators[chosen];
    if (other >= 0) {
      const better = front.axes.filter((_, i) => front.maximised[other][i] > front.maximised[chosen][i]);
      why += ` Policy ${front.numbers[other]} is nowhere worse, and better in ${better.map(({ name }) => name).join(", ")}.`;
    }
    const success = front.success[chosen];
    const values = front.columns.map((i) => [front.axes[i].name, withUnit(front.text(front.rows[chosen][i], i), front.axes[i].unit)]);
    const [low, high] = (front.successRange[chosen] ?? []).map((share) => (100 * share).toFixed(0));
    if (success !== null) values.push(["arrivals", percent(success) + (low ? ` (95% interval ${low} to ${high}%)` : "")]);
    fill("values", values.flatMap(([name, text]) => [element("dt", {}, name), element("dd", {}, text)]));
    byId("command").value = this.command();
    say({ why, "command-label": front.command.includes("{preference}") ? "Evaluate it again" : "Its actions", copied: "" });
  }

  showLegend() {
    const { front } = this;
    const entries = this.shownPolicies().map((k, place) =>
      element("span", {}, swatch(place), `policy ${front.numbers[k]}${place ? "" : " (chosen)"}`));
    if (front.bestKnown.length) entries.push(element("span", {}, element("span", { class: "swatch",
      style: "border-top: 2px dotted var(--front)" }), `best known (${front.bestKnown.length} policies)`));
    fill("parallel-legend", entries);
    const hidden = front.dominators.filter((other) => other >= 0).length;
    hide({ "dominated-choice": hidden === 0 });
    byId("dominated").checked = this.state.dominated;
    const [count, listed] = [this.kept(), this.listed()].map((each) => each.filter(Boolean).length);
    const outside = this.inRanges(this.chosen()) ? "" : "; the chosen policy is outside of the ranges";
    say({ kept: count === listed ? "" : `${count} of ${listed} policies are in the ranges${outside}.`,
      "dominated-label": `show dominated policies (${hidden} of ${front.size})` });
    for (const input of document.querySelectorAll("[data-range]")) {
      const [i, end] = input.dataset.range.split("/").map(Number);
      const value = this.state.ranges[i]?.[end];
      input.value = Number.isFinite(value) ? value : "";
    }
  }
  /** Change the state from a control in a table, which is made anew, and give the focus to the control's successor. */
  updateFrom(control, selector, changes) {
    const table = control.closest("table");
    this.update(changes);
    (table.querySelector(selector) ?? table.parentElement).focus();
  }
  /** Cells with the controls of a policy: choose it, and compare it with the chosen one. */
  controls(k) {
    const number = this.front.numbers[k];
    const on = this.state.compared.includes(k);
    const full = !on && this.state.compared.length >= MOST_COMPARED;
    return [element("button", { type: "button", "data-pick": k, "aria-label": `choose policy ${number}`, onclick: ({ target }) =>
      this.updateFrom(target, `[data-pick="${k}"]`, { mode: "picked", picked: k }) }, "Choose"),
    element("input", { type: "checkbox", checked: on, disabled: full || k === this.chosen(), "data-compare": k,
      "aria-label": `compare policy ${number}`, onchange: ({ target }) => {
        const others = this.state.compared.filter((each) => each !== k);
        this.updateFrom(target, `[data-compare="${k}"]`, { compared: target.checked ? [...others, k] : others });
      } })].map((control) => element("td", {}, control));
  }

  showTrades() {
    const { front } = this;
    const chosen = this.chosen();
    byId("trades").closest("section").hidden = front.size < 2;
    const difference = (k, i) => {
      const step = front.rows[k][i] - front.rows[chosen][i];
      const text = front.text(step, i, true);
      if (Number(text.replace("−", "-")) === 0) return element("td", {}, "0");
      const better = step * front.axes[i].way > 0;
      return element("td", { class: better ? "better" : "worse" }, `${better ? "▲" : "▼"} ${text}`);
    };
    const reason = (better) => (better.length ? `better ${better.map((i) => front.axes[i].name).join(", ")}` : "a small change");
    fillTable(byId("trades"), ["For", "Policy", ...front.columns.map((i) => titled(front.axes[i])), "", "Compare"],
      alternatives(front.maximised, chosen, this.listed()).map(({ k, better }) => element("tr", {},
        element("th", { scope: "row" }, reason(better)), element("td", {}, String(front.numbers[k])),
        ...front.columns.map((i) => difference(k, i)), ...this.controls(k))));
  }

  showTable() {
    const { front } = this;
    const [kept, chosen] = [this.kept(), this.chosen()];
    const arrivals = front.success.every((share) => share !== null);
    const columns = [{ name: "Policy", of: (k) => front.numbers[k], text: String },
      ...front.columns.map((i) => ({ name: titled(front.axes[i]), of: (k) => front.rows[k][i], text: (value) => front.text(value, i) })),
      ...(arrivals ? [{ name: "arrivals", of: (k) => front.success[k], text: percent }] : []),
      { name: "decisions", of: (k) => front.lengths[k], text: (value) => value.toFixed(0) } ];
    const { column: by, way } = columns[this.sorting?.column] ? this.sorting : { column: -1, way: 0 };
    const order = front.means.map((_, k) => k);
    if (way) order.sort((a, b) => way * (columns[by].of(a) - columns[by].of(b)) || a - b);
    const sort = (column) => {
      this.sorting = { column, way: by === column ? -way : -1 };
      this.showTable();
      byId("policies").querySelectorAll("thead button")[column].focus();
    };
    const cell = ({ of, text }, k, i) => (i ? element("td", {}, text(of(k))) : element("th", { scope: "row" }, text(of(k))));
    fillTable(byId("policies"), [...columns.map(({ name }, column) => element("button", { type: "button", onclick: () => sort(column) },
      `${name}${column === by ? ["\u00a0↓", "", "\u00a0↑"][way + 1] : ""}`)), "", "Compare"],
    order.filter((k) => kept[k] || k === chosen).map((k) => element("tr", {
      "data-policy": k, class: [k === chosen ? "chosen" : "", kept[k] ? "" : "out"].join(" ").trim() },
    ...columns.map((column, i) => cell(column, k, i)), ...this.controls(k))));
    byId("policies").querySelectorAll("thead th").forEach((heading, column) =>
      heading.setAttribute("aria-sort", column === by ? ["descending", "none", "ascending"][way + 1] : "none"));
  }

  showDrives() {
    const { front, state } = this;
    if (!front.scenes.length) return;
    byId("scenario").value = state.scenario;
    this.scene = front.scenes[state.scenario];
    this.shown = this.shownPolicies().map((k) => ({ label: String(front.numbers[k]), drive: front.drive(state.scenario, k) }));
    this.last = Math.max(...this.shown.map(({ drive }) => drive.decisions));
    byId("time").max = this.last;
    byId("cars").hidden = this.shown[0].drive.cars.length === 0 || this.shown.length === 1;
    this.map.show(this.scene, this.shown);
    this.drawTimes();
    this.showStep(Math.min(this.step, this.last));
  }

  drawTimes() {
    if (!this.front.scenes.length || !this.shown) return;
    const hosts = ["g_force", "jerk"].map((name) => element("div", { "data-reading": name }));
    fill("charts", hosts);
    const names = this.shown.map(({ label }) => `policy ${label}`).join(", ");
    this.rules = hosts.map((host, i) => drawTimes(host, ["g-force (g)", "jerk (m/s³)"][i],
      this.shown.map(({ drive }) => drive.vehicles[this.front.vehicle][host.dataset.reading]), this.scene.frequency, names));
    for (const rule of this.rules) rule(this.step / this.scene.frequency);
  }

  showStep(step) {
    this.step = step;
    const seconds = (count) => `${(count / this.scene.frequency).toFixed(1)} s`;
    byId("time").value = step;
    byId("time").setAttribute("aria-valuetext", seconds(step));
    byId("clock").textContent = `${seconds(step)} of ${seconds(this.last)}`;
    this.map.move(step);
    for (const rule of this.rules) rule(step / this.scene.frequency);
    const rows = this.shown.flatMap(({ label, drive }, place) => drive.vehicles.map((vehicle, v) => {
      const now = Math.min(step, vehicle.decisions);
      const name = `policy ${label}${drive.vehicles.length > 1 ? `, vehicle ${v}` : ""}`;
      return element("tr", {}, element("th", { scope: "row" }, swatch(place), name), ...cells([vehicle.speed[now].toFixed(2),
        vehicle.g_force[now].toFixed(3), vehicle.jerk[now].toFixed(1), step >= vehicle.decisions ? plain(vehicle.end) : "driving"]));
    }));
    fillTable(byId("readings-table"), ["", "speed (m/s)", "g-force (g)", "jerk (m/s³)", ""], rows);
    if (!this.player.playing) this.showPlaying();
  }

  togglePlay() {
    if (this.player.playing) this.player.stop();
    else this.player.play(this.step, this.last, this.scene.frequency);
    this.showPlaying();
  }

  stop() { this.player.stop(); this.showPlaying(); }

  showPlaying() {
    say({ play: this.player.playing ? "Pause" : "Play" });
    byId("play").setAttribute("aria-pressed", this.player.playing);
  }
}
