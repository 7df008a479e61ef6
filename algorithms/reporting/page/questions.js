// "Which do you prefer?": the questions and what the answers say, as mo_deepdrive/evaluation/elicitation.py finds them.

const SIDES = ["left", "right"];

class Questions {
  constructor(page, take) {
    this.row = page.worlds.find(({ questions }) => questions);
    this.maps = SIDES.map((side) => new DriveMap(byId(`${side}-map`)));
    this.player = new Player((step) => this.show(step), true);
    SIDES.forEach((side, which) => on(side, () => this.answer(which)));
    on("ask-again", () => this.begin());
    on("take", () => take(this.row, this.facts, this.found.weights));
    window.addEventListener("keydown", ({ key }) => {
      const which = { 1: 0, ArrowLeft: 0, 2: 1, ArrowRight: 1 }[key];
      if (which !== undefined && !byId("questions").hidden && !byId("pair").hidden) this.answer(which);
    });
  }

  async begin() { this.node = 1; await this.ask(); }
  async resume() { if (this.episodes && !byId("pair").hidden) this.play(); else await this.begin(); }

  /** The question of a node of the tree of answers, or what they say at a leaf. */
  async ask() {
    this.facts = (await World.make(this.row)).facts;
    const { facts: { objectives, questions, vehicles, frequency }, node } = this;
    const pair = questions.ask[node - 1];
    hide({ pair: !pair, answer: Boolean(pair) });
    if (!pair) return this.conclude();
    const [count, all] = [1 + Math.floor(Math.log2(node)), Math.log2(questions.ask.length + 1)];
    this.episodes = await Promise.all(pair.map(async (k) => {
      const { seed, actions } = questions.drives[k];
      const episode = new Episode(await World.make(this.row), seed, times(vehicles, (v) => byActions(decodeActions(actions[v]))));
      while (!episode.over) episode.step();
      return episode;
    }));
    say({ question: `Question ${count} of ${all}: which drive would you rather sit in?` });
    const returns = this.episodes.map((episode) => episode.returns[0]);
    SIDES.forEach((side, which) =>
      this.maps[which].show(this.episodes[which].scene, [{ label: `the ${side} drive`, drive: this.episodes[which] }]));
    fillTable(byId("pair-returns"), ["", ...SIDES], objectives.map(({ name, unit }, i) => {
      const values = returns.map((row) => row[i]);
      const texts = values.map((value) => withUnit(formatted(value, sum(values.map(Math.abs))), unit));
      return element("tr", {}, element("th", { scope: "row" }, name), ...texts.map((text, which) => {
        const better = values[which] > values[1 - which];
        return element("td", { class: better ? "better" : "" }, better ? `▲ ${text}` : text);
      }));
    }));
    this.last = Math.max(...this.episodes.map(({ decisions }) => decisions)) + frequency;
    return this.play();
  }

  play() { this.player.play(0, this.last, this.facts.frequency); }
  /** Both drives at one time; they start again when both have ended, while anyone looks. */
  show(step) {
    this.maps.forEach((map, which) => map.move(Math.min(step, this.episodes[which].decisions)));
    if (!this.player.playing && !byId("questions").hidden && !byId("pair").hidden) this.play();
  }

  answer(which) {
    this.player.stop();
    this.node = 2 * this.node + which;
    this.ask().catch(showError);
  }

  conclude() {
    const { objectives, questions, policies } = this.facts;
    const { weights, low, high, best } = (this.found = questions.found[this.node - questions.ask.length - 1]);
    say({ question: "", advice: `Take ${questions.drives[best].label}: of these drives it is worth most under your weights.` });
    fill("weights-found", objectives.map(({ name }, i) => {
      const text = `${percent(weights[i])} (${percent(low[i])} to ${percent(high[i])})`;
      const range = element("b", { style: `left: ${percent(low[i])}; width: ${percent(high[i] - low[i])}` });
      return barOf(name, i, objectives.length, text, percent(weights[i]), range);
    }));
    const named = objectives.map(({ key, scale }, i) => `${key}=${Number((weights[i] / scale).toPrecision(3))}`);
    byId("choose-command").value = `mo-deepdrive choose ${policies.find(({ conditioned }) => conditioned).name} --weights ${named.join(" ")}`;
  }
}
