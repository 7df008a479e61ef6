// "Which do you prefer?": weights from answers, as mo_deepdrive/evaluation/elicitation.py estimates them.

const QUESTIONS = 7;

/** The probability that a person with these weights (d) prefers the first of two scaled returns (d). */
const preferring = (weights, a, b, temperature) =>
  1 / (1 + Math.exp(-sum(weights.map((w, i) => w * (a[i] - b[i]))) / temperature));

/** The posterior (n) over samples of weights after answers { pair: [a, b], first }, of scaled returns (k, d). */
function posteriorOf({ samples, temperature }, returns, answers) {
  const likely = samples.map((weights) => answers.reduce((product, { pair: [a, b], first }) => {
    const share = preferring(weights, returns[a], returns[b], temperature);
    return product * (first ? share : 1 - share);
  }, 1));
  const total = sum(likely);
  return likely.map((each) => each / total);
}

/** The pair of drives whose comparison tells most about the weights, of those that have not been asked for. */
function nextPair({ samples, temperature }, returns, answers, posterior) {
  const entropy = (p) => (p > 0 && p < 1 ? -p * Math.log(p) - (1 - p) * Math.log(1 - p) : 0);
  let [best, most] = [null, -Infinity];
  for (let a = 0; a < returns.length; a++) {
    for (let b = a + 1; b < returns.length; b++) {
      if (answers.some(({ pair }) => pair[0] === a && pair[1] === b)) continue;
      const shares = samples.map((weights) => preferring(weights, returns[a], returns[b], temperature));
      const over = (values) => sum(values.map((value, n) => posterior[n] * value));
      const told = entropy(over(shares)) - over(shares.map(entropy));
      if (told > most) [best, most] = [[a, b], told];
    }
  }
  return best;
}

/** Value below which a share of the posterior lies. */
function quantile(values, posterior, share) {
  const order = values.map((_, n) => n).sort((a, b) => values[a] - values[b]);
  let total = 0;
  return values[order.find((n) => (total += posterior[n]) >= share) ?? order.at(-1)];
}

class Questions {
  constructor(page, take) {
    this.page = page;
    this.row = page.worlds.find(({ questions }) => questions);
    this.maps = ["left", "right"].map((side) => new DriveMap(byId(`${side}-map`)));
    this.player = new Player((step) => this.show(step), true);
    byId("left").addEventListener("click", () => this.answer(true));
    byId("right").addEventListener("click", () => this.answer(false));
    byId("ask-again").addEventListener("click", () => this.begin());
    byId("take").addEventListener("click", () => take(this.row, this.facts, this.found));
    window.addEventListener("keydown", ({ key }) => {
      if (byId("questions").hidden || byId("pair").hidden) return;
      if (["1", "ArrowLeft"].includes(key)) this.answer(true);
      if (["2", "ArrowRight"].includes(key)) this.answer(false);
    });
  }

  async begin() {
    this.facts ??= (await World.make(this.row)).facts;
    const { objectives, questions } = this.facts;
    this.returns = questions.drives.map(({ returns }) => returns.map((value, i) => value / objectives[i].scale));
    this.answers = [];
    await this.ask();
  }

  async ask() {
    const { facts, answers } = this;
    const posterior = posteriorOf(facts.questions, this.returns, answers);
    const done = answers.length === QUESTIONS;
    byId("pair").hidden = done;
    byId("answer").hidden = !done;
    if (done) return this.conclude(posterior);
    byId("question").textContent = `Question ${answers.length + 1} of ${QUESTIONS}: which drive would you rather sit in?`;
    this.pair = nextPair(facts.questions, this.returns, answers, posterior);
    this.episodes = await Promise.all(this.pair.map(async (k) => {
      const { seed, actions } = facts.questions.drives[k];
      const drivers = Array.from({ length: facts.vehicles }, (_, v) => byActions(decodeActions([actions].flat()[v] ?? "")));
      return new Episode(await World.make(this.row, this.page.version), seed, drivers).finish();
    }));
    const extents = facts.objectives.map((_, i) => Math.abs(this.episodes[0].returns[0][i]) + Math.abs(this.episodes[1].returns[0][i]));
    this.episodes.forEach((episode, side) => {
      this.maps[side].show(episode.scene, [{ label: ["left drive", "right drive"][side], drive: episode }]);
      const [mine, other] = [episode, this.episodes[1 - side]].map(({ returns }) => returns[0]);
      fillTable(byId(["left-returns", "right-returns"][side]), [], facts.objectives.map((objective, i) => element("tr", {},
        element("th", { scope: "row" }, objective.name), element("td", { class: mine[i] > other[i] ? "better" : "" },
          `${mine[i] > other[i] ? "▲ " : ""}${withUnit(formatted(mine[i], extents[i]), objective.unit)}`))));
    });
    this.play();
  }

  play() {
    this.player.play(0, Math.max(...this.episodes.map(({ decisions }) => decisions)) + this.facts.frequency, this.facts.frequency);
  }

  /** Both drives at one time; they start again when both have ended, while anyone looks. */
  show(step) {
    this.maps.forEach((map, side) => map.move(Math.min(step, this.episodes[side].decisions)));
    if (!this.player.playing && !byId("questions").hidden && !byId("pair").hidden) this.play();
  }

  answer(first) {
    this.player.stop();
    this.answers.push({ pair: this.pair, first });
    return this.ask().catch(showError);
  }

  conclude(posterior) {
    const { facts } = this;
    const { samples, drives } = facts.questions;
    const columns = facts.objectives.map((_, i) => samples.map((weights) => weights[i]));
    this.found = columns.map((column) => sum(column.map((weight, n) => weight * posterior[n])));
    const worth = this.returns.map((row) => sum(row.map((value, i) => value * this.found[i])));
    const best = drives[worth.indexOf(Math.max(...worth))];
    byId("question").textContent = "";
    byId("advice").textContent = `Take ${best.label}: of all drives that could be asked for it is worth most under these weights.`;
    byId("weights-found").replaceChildren(...facts.objectives.map(({ name }, i) => {
      const [low, high] = [0.05, 0.95].map((share) => quantile(columns[i], posterior, share));
      return element("div", { class: "bar", style: `--hue: ${colourOf(facts.objectives.map((_, k) => Number(k === i)))}` },
        element("span", {}, name), element("span", {}, element("i", { style: `width: ${percent(this.found[i])}` }),
          element("b", { style: `left: ${percent(low)}; width: ${percent(high - low)}` })),
        element("output", {}, `${percent(this.found[i])} (${percent(low)} to ${percent(high)})`));
    }));
    const weights = facts.objectives.map(({ key, scale }, i) => `${key}=${Number((this.found[i] / scale).toPrecision(3))}`);
    byId("choose-command").value = `mo-deepdrive choose ${best.policy ?? facts.policies.find((each) => each.conditioned)?.name ?? "RUN"} `
      + `--weights ${weights.join(" ")}`;
  }
}
