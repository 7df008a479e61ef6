// The page: its state, and what shows it.

class Explorer {
  constructor(fronts) {
    this.fronts = fronts.map((front) => new FrontModel(front));
    this.map = new DriveMap(byId("map"));
    this.player = new Player((step) => this.showStep(step));
    this.step = 0;
    this.charts = [];
    this.panels = new Panels(this);
    this.wire();
    this.read(location.hash);
    this.showFront();
  }

  get front() {
    return this.fronts[this.index];
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

  /** Whether each policy is drawn and listed: all of them, or those that no other one dominates. */
  listed() {
    return this.front.dominators.map((other) => this.state.dominated || other < 0);
  }

  inRanges(k) {
    return Object.entries(this.state.ranges).every(([i, [low, high]]) =>
      this.front.rows[k][i] >= low && this.front.rows[k][i] <= high);
  }

  /** Whether each policy is listed and in the ranges. */
  kept() {
    return this.listed().map((listed, k) => listed && this.inRanges(k));
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
    } else preference = `--target ${named(front.undiscounted[state.picked].map((value, i) => [keys[i], value]))}`;
    // The command chooses by undiscounted returns, so it is told the policy where others are shown.
    if (front.gamma < 1) preference += ` --policy ${front.numbers[this.chosen()]}`;
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
    change("returns", "change", (event) => {
      this.state.returns = Number(event.target.value);
      this.state.ranges = {};
      this.showFront();
    });
    change("dominated", "change", (event) => this.update({ dominated: event.target.checked }));
    for (const input of document.querySelectorAll("input[name=mode]")) {
      input.addEventListener("change", () => this.update({ mode: input.value }));
    }
    change("reset", "click", () => {
      this.state = this.front.initialState();
      this.showFront();
    });
    change("copy-command", "click", () => copy(byId("command").value, "command", byId("copied")));
    change("copy-link", "click", () => copy(location.href.split("#")[0] + this.hash, "link", byId("copied")));
    change("command", "focus", (event) => event.target.select());
    change("play", "click", () => this.togglePlay());
    change("time", "input", (event) => {
      this.stop();
      this.showStep(Number(event.target.value));
    });
    change("speed", "change", (event) => (this.player.speed = Number(event.target.value)));
    change("scenario", "change", (event) => this.update({ scenario: Number(event.target.value) }));
    change("vehicle", "change", (event) => {
      const { step } = this;
      this.front.vehicle = Number(event.target.value);
      this.showFront();
      this.showStep(step);
    });
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

  /** Take over the state of a link. */
  read(hash) {
    ({ index: this.index, state: this.state } = stateOfLink(hash, this.fronts));
  }

  /** Change parts of the state. */
  update(changes) {
    Object.assign(this.state, changes);
    this.refresh();
  }

  /** Show another front, or the state of a link. */
  showFront() {
    const { front, state } = this;
    front.take(state.returns);
    this.stop();
    byId("front-select").value = this.index;
    byId("title").textContent = front.title;
    byId("title").hidden = this.fronts.length > 1;
    byId("content").hidden = front.size === 0;
    showMessage(front.size === 0 ? `The front “${front.title}” has no policies.`
      : front.size === 1 ? "This front has one policy: there is nothing to choose between." : "");
    if (front.size === 0) return;
    byId("note").textContent = front.note;
    byId("returns-choice").hidden = front.measured.length < 2;
    byId("returns").replaceChildren(...front.measured.map(({ gamma }, i) =>
      element("option", { value: i }, gamma === 1 ? "undiscounted" : `discounted, γ = ${gamma}`)));
    byId("returns").value = state.returns;
    byId("sums").textContent = front.gamma === 1 ? "undiscounted sums over a drive"
      : `sums over a drive, discounted by γ = ${front.gamma} per decision`;
    byId("no-drive").hidden = front.scenes.length > 0;
    byId("drives").hidden = front.scenes.length === 0;
    byId("budget-mode").hidden = !front.budget;
    byId("modes").hidden = !front.budget;
    byId("scenario-choice").hidden = front.scenes.length < 2;
    byId("scenario").replaceChildren(
      ...front.scenes.map((scene, i) => element("option", { value: i }, `${i + 1} (seed ${scene.seed})`)));
    byId("vehicle-choice").hidden = front.vehicles < 2;
    byId("vehicle").replaceChildren(...Array.from({ length: front.vehicles }, (_, v) =>
      element("option", { value: v }, String(v))));
    byId("vehicle").value = front.vehicle;
    this.panels.makeSliders();
    this.panels.makeRanges();
    this.width = byId("parallel").clientWidth;
    this.drawParallel();
    this.step = 0;
    this.drawn = "";
    this.refresh();
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
    const axes = front.columns.map((i) => ({ axis: i, title: titled(front.axes[i]),
      worst: front.text(front.valueAt(0, i), i), best: front.text(front.valueAt(1, i), i) }));
    const points = (rows) => rows.flatMap((row, policy) => front.columns.filter((i) => i < row.length).map((axis) => ({
      policy, axis, value: front.scaled(row[axis], axis) })));
    byId("parallel").dataset.upright = isUpright(axes, this.width);
    const view = makeView(parallelSpec(axes, this.width), byId("parallel"),
      `Parallel coordinates of ${front.size} policies; the table of all policies has their numbers`);
    view.data("axes", axes).data("bestKnown", points(front.bestKnown)).data("learnt", points(front.rows));
    const listen = (signal, action) =>
      view.addSignalListener(signal, (_, value) => view.runAfter(() => action(value)));
    listen("picked", ({ policy }) => this.update({ mode: "picked", picked: policy }));
    listen("brushing", ({ axis, from, to }) => {
      const ends = [from, to].map((share) => Number(front.valueAt(share, axis).toPrecision(5)));
      this.setRange(axis, Math.abs(from - to) < 0.01 ? null : [Math.min(...ends), Math.max(...ends)]);
    });
    this.parallel = view;
    this.showParallel();
  }

  showParallel() {
    const share = (value, axis) => Math.min(Math.max(this.front.scaled(value, axis), 0), 1);
    const brushes = this.front.columns.filter((axis) => this.state.ranges[axis]).map((axis) => ({
      axis, low: share(this.state.ranges[axis][0], axis), high: share(this.state.ranges[axis][1], axis) }));
    this.parallel.data("brushes", brushes).signal("chosen", this.shownPolicies()).signal("listed", this.listed())
      .signal("kept", this.kept()).run();
  }

  refresh() {
    this.hash = linkOfState(this.index, this.state);
    clearTimeout(this.writing); // browsers limit how often a page may change its address
    this.writing = setTimeout(() => history.replaceState(null, "", this.hash), 200);
    this.panels.showChoice();
    // A slider changes the choice now and then only, and drawing takes a while.
    const { compared, ranges, scenario, dominated } = this.state;
    const drawn = JSON.stringify([this.chosen(), compared, ranges, scenario, dominated]);
    if (drawn === this.drawn) return;
    this.drawn = drawn;
    this.panels.show();
    this.showParallel();
    this.showDrives();
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
    byId("cars").hidden = this.shown[0].drive.cars.length === 0 || this.shown.length === 1;
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
      const rows = this.shown.flatMap(({ drive }, place) =>
        drive.vehicles[this.front.vehicle][name].map((value, step) => ({
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
    const cells = this.shown.flatMap(({ label, drive }, place) => drive.vehicles.map((vehicle, v) => {
      const now = Math.min(step, vehicle.decisions);
      const state = step >= vehicle.decisions ? vehicle.end.replaceAll("_", " ") : "driving";
      const name = `policy ${label}${drive.vehicles.length > 1 ? `, vehicle ${v}` : ""}`;
      const readings = [vehicle.speed[now].toFixed(2), vehicle.g_force[now].toFixed(3), vehicle.jerk[now].toFixed(1)];
      return element("tr", {}, element("th", { scope: "row" }, swatch(place), name),
        ...[...readings, state].map((text) => element("td", {}, text)));
    }));
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
