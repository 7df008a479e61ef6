// What is written beside the plots: sliders, the choice, what it would give up, and the table of all policies.

const between = (range) => (range === null ? "" : ` (95% interval ${(100 * range[0]).toFixed(0)} to ${percent(range[1])})`);

class Panels {
  /** `explorer` knows the front and its state, and takes changes by `update`. */
  constructor(explorer) {
    this.explorer = explorer;
    this.sorting = null;
  }

  get front() {
    return this.explorer.front;
  }

  get state() {
    return this.explorer.state;
  }

  /** Bring everything but the choice up to date. */
  show() {
    this.showLegend();
    this.showTrades();
    this.showTable();
  }

  makeSliders() {
    const { front, state } = this;
    const shown = front.columns.filter((i) => i < front.objectives.length).map((i) => [front.objectives[i], i]);
    byId("weights").replaceChildren(...shown.map(([objective, i]) => slider({
      id: `weight-${i}`,
      label: objective.name,
      value: state.weights[i],
      max: 100,
      step: 1,
      text: (importance) => `weight ${weightOf(importance, objective.scale)}`,
      change: (importance) => this.explorer.update({ mode: "weights", weights: state.weights.with(i, importance) }),
    })));
    byId("budgets").replaceChildren(...Object.keys(front.budget?.excessPrices ?? {}).map((key) => {
      const i = front.objectives.findIndex((objective) => objective.key === key);
      const objective = front.objectives[i];
      const most = Math.max(2 * front.budget[key], ...front.means.map((row) => row[i] * objective.sign));
      const step = 10 ** Math.floor(Math.log10(most / 50));
      return slider({
        id: `budget-${i}`,
        label: `${objective.name} free up to`,
        value: state.budget[key],
        max: Math.ceil(most / step) * step,
        step,
        text: (limit) => withUnit(String(limit), objective.unit),
        change: (limit) => this.explorer.update({ mode: "budget", budget: { ...this.state.budget, [key]: limit } }),
      });
    }));
  }

  makeRanges() {
    const { front } = this;
    byId("ranges").replaceChildren(...front.columns.map((i) => {
      const axis = front.axes[i];
      const limit = (end, name) => element("input", { type: "number", step: "any", "data-range": `${i}/${end}`,
        "aria-label": `${name} ${titled(axis)}`, onchange: (event) => {
          const range = [...(this.state.ranges[i] ?? [-Infinity, Infinity])];
          range[end] = event.target.value === "" ? [-Infinity, Infinity][end] : Number(event.target.value);
          this.explorer.setRange(i, range);
        } });
      return element("div", { class: "range", role: "group", "aria-label": titled(axis) },
        element("span", {}, titled(axis)), limit(0, "least"), "to", limit(1, "most"));
    }));
  }

  /** What counts in the utility with a comfort budget. */
  budgetRule() {
    const { budget, objectives } = this.front;
    const named = (prices) => Object.entries(prices)
      .map(([key, price]) => `${objectives.find((objective) => objective.key === key).name} ${price}`);
    const costs = [`${named(budget.excessPrices).join(" and ")} beyond their budgets`, ...named(budget.prices)];
    return `It has the greatest expected utility. Gains per unit: ${named(budget.gains).join(", ")}. `
      + `Costs per unit: ${costs.join(", ")}.`;
  }

  showChoice() {
    const { front, state } = this;
    const chosen = this.explorer.chosen();
    byId("weights").hidden = state.mode === "budget";
    byId("budgets").hidden = state.mode !== "budget";
    for (const input of document.querySelectorAll("input[name=mode]")) input.checked = input.value === state.mode;
    const heading = `Policy ${front.numbers[chosen]}`;
    if (byId("chosen").textContent !== heading) byId("chosen").textContent = heading;
    byId("chosen").dataset.policy = chosen;
    const first = this.explorer.order()[0];
    byId("why").textContent = {
      weights: "It has the greatest weighted sum of mean returns. A weight counts per unit of the return."
        + (front.gamma < 1 ? " The command scores it by undiscounted returns." : ""),
      budget: state.mode === "budget" ? this.budgetRule() : "",
      picked: first === chosen || front.gamma < 1 ? "Chosen by hand; a slider chooses by preference again."
        : `Chosen by hand. The command chooses policy ${front.numbers[first]}, which is at least as good in every objective.`,
    }[state.mode];
    const other = front.dominators[chosen];
    if (other >= 0) {
      const better = front.axes.filter((_, i) => front.maximised[other][i] > front.maximised[chosen][i]);
      byId("why").textContent += ` Policy ${front.numbers[other]} is nowhere worse, and better in `
        + `${better.map(({ name }) => name).join(", ")}.`;
    }
    const success = front.success[chosen];
    byId("values").replaceChildren(
      ...front.columns.flatMap((i) => [element("dt", {}, front.axes[i].name),
        element("dd", {}, withUnit(front.text(front.rows[chosen][i], i), front.axes[i].unit))]),
      ...(success === null ? [] : [element("dt", {}, "arrivals"),
        element("dd", {}, `${percent(success)}${between(front.successRange[chosen])}`)]));
    byId("command").value = this.explorer.command();
    byId("command-label").textContent = front.command.includes("{preference}") ? "Evaluate it again" : "Its actions";
    byId("copied").textContent = "";
  }

  showLegend() {
    const { front } = this;
    const entries = this.explorer.shownPolicies().map((k, place) =>
      element("span", {}, swatch(place), `policy ${front.numbers[k]}${place ? "" : " (chosen)"}`));
    if (front.bestKnown.length) entries.push(element("span", {}, element("span", { class: "swatch",
      style: "border-top: 2px dotted var(--front)" }), `best known (${front.bestKnown.length} policies)`));
    byId("parallel-legend").replaceChildren(...entries);
    const hidden = front.dominators.filter((other) => other >= 0).length;
    byId("dominated-choice").hidden = hidden === 0;
    byId("dominated").checked = this.state.dominated;
    byId("dominated-label").textContent = `show dominated policies (${hidden} of ${front.size})`;
    const kept = this.explorer.kept();
    const [count, listed] = [kept, this.explorer.listed()].map((each) => each.filter(Boolean).length);
    const outside = this.explorer.inRanges(this.explorer.chosen()) ? "" : "; the chosen policy is outside of the ranges";
    byId("kept").textContent = count === listed ? "" : `${count} of ${listed} policies are in the ranges${outside}.`;
    for (const input of document.querySelectorAll("[data-range]")) {
      const [i, end] = input.dataset.range.split("/").map(Number);
      const value = this.state.ranges[i]?.[end];
      input.value = Number.isFinite(value) ? value : "";
    }
  }

  /** Change the state from a control in a table, which is made anew, and give the focus to the control's successor. */
  updateFrom(control, selector, changes) {
    const table = control.closest("table");
    this.explorer.update(changes);
    (table.querySelector(selector) ?? table.parentElement).focus();
  }

  pickButton(k) {
    return element("button", { type: "button", "data-pick": k, "aria-label": `choose policy ${this.front.numbers[k]}`,
      onclick: (event) => this.updateFrom(event.target, `[data-pick="${k}"]`, { mode: "picked", picked: k }) }, "Choose");
  }

  compareBox(k) {
    const on = this.state.compared.includes(k);
    const full = !on && this.state.compared.length >= MOST_COMPARED;
    return element("input", { type: "checkbox", checked: on, disabled: full || k === this.explorer.chosen(),
      "data-compare": k, "aria-label": `compare policy ${this.front.numbers[k]}`, onchange: (event) => {
        const others = this.state.compared.filter((each) => each !== k);
        const compared = event.target.checked ? [...others, k] : others;
        this.updateFrom(event.target, `[data-compare="${k}"]`, { compared });
      } });
  }

  showTrades() {
    const { front } = this;
    const chosen = this.explorer.chosen();
    const found = alternatives(front.maximised, chosen, this.explorer.listed());
    byId("trades").closest("section").hidden = front.size < 2;
    const difference = (k, i) => {
      const step = front.rows[k][i] - front.rows[chosen][i];
      const text = front.text(step, i, true);
      if (Number(text.replace("−", "-")) === 0) return element("td", {}, "0");
      const better = step * front.axes[i].way > 0;
      return element("td", { class: better ? "better" : "worse" }, `${better ? "▲" : "▼"} ${text}`);
    };
    byId("trades").replaceChildren(
      element("thead", {}, element("tr", {}, ...["For", "Policy",
        ...front.columns.map((i) => titled(front.axes[i])), "", "Compare"].map(
        (text) => element("th", { scope: "col" }, text)))),
      element("tbody", {}, ...found.map(({ k, better }) => element("tr", {},
        element("th", { scope: "row" }, better.length ? `better ${better.map((i) => front.axes[i].name).join(", ")}`
          : "a small change"),
        element("td", {}, String(front.numbers[k])),
        ...front.columns.map((i) => difference(k, i)),
        element("td", {}, this.pickButton(k)), element("td", {}, this.compareBox(k))))));
  }

  showTable() {
    const { front } = this;
    const kept = this.explorer.kept();
    const chosen = this.explorer.chosen();
    const arrivals = front.success.every((share) => share !== null);
    const columns = [
      { name: "Policy", of: (k) => front.numbers[k], text: (k) => String(front.numbers[k]) },
      ...front.columns.map((i) => ({
        name: titled(front.axes[i]), of: (k) => front.rows[k][i], text: (k) => front.text(front.rows[k][i], i) })),
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
}
