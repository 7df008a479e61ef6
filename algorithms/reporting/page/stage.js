// The tabs on which someone drives: a person, a network under preferences, or both.

const KEYS = { ArrowUp: 0, w: 0, ArrowDown: 1, s: 1, ArrowLeft: 2, a: 2, ArrowRight: 3, d: 3 };
const HOLD = 1.5; // s for which the last picture of a drive without a person stays

/** What keys, thumb and gamepad ask for: accelerate, brake, left, right. */
class Controls {
  constructor(pad, thumb, wake) {
    Object.assign(this, { thumb, wake, held: new Set(), tapped: new Set(), drag: [], from: null });
    window.addEventListener("keydown", (event) => this.press(event));
    window.addEventListener("keyup", ({ key }) => this.held.delete(KEYS[key] ?? KEYS[key.toLowerCase()]));
    window.addEventListener("blur", () => this.held.clear());
    pad.addEventListener("pointerdown", (event) => { pad.setPointerCapture(event.pointerId); this.from = event; });
    pad.addEventListener("pointermove", (event) => this.from && this.move(event));
    for (const name of ["pointerup", "pointercancel"]) pad.addEventListener(name, () => this.move(null));
  }

  press(event) {
    const key = KEYS[event.key] ?? KEYS[event.key.toLowerCase()];
    if (key === undefined || isWriting(event) || !this.wake()) return;
    event.preventDefault();
    this.held.add(key);
    this.tapped.add(key);
  }

  move(event) {
    const [x, y] = event ? [event.clientX - this.from.clientX, event.clientY - this.from.clientY] : [0, 0];
    if (!event) this.from = null;
    const dead = 14; // pixels
    this.drag = [y < -dead, y > dead, x < -dead, x > dead];
    this.thumb.style.transform = `translate(${Math.max(-60, Math.min(x, 60))}px, ${Math.max(-38, Math.min(y, 38))}px)`;
    if (this.drag.some(Boolean)) this.wake();
  }

  gamepad() {
    const pad = [...(navigator.getGamepads?.() ?? [])].find(Boolean);
    const down = (...buttons) => buttons.some((k) => pad?.buttons[k]?.pressed);
    return [down(7, 0), down(6, 1), pad?.axes[0] < -0.3, pad?.axes[0] > 0.3];
  }
  /** What has been asked for since the last call: a short press is not lost. */
  take() {
    const asked = this.gamepad().map((on, key) => Boolean(on || this.held.has(key) || this.tapped.has(key) || this.drag[key]));
    this.tapped.clear();
    return asked;
  }
}

/** Whether a key is meant for a field, or for the browser. */
const isWriting = ({ target, ctrlKey, metaKey, altKey }) =>
  /^(INPUT|SELECT|TEXTAREA)$/.test(target.tagName) || ctrlKey || metaKey || altKey;

/** Colour of weights (d): the hues of the objectives, mixed. */
function colourOf(weights) {
  const angle = (i) => (2 * Math.PI * (i + 0.1)) / weights.length;
  const total = sum(weights) || 1;
  const [x, y] = [Math.cos, Math.sin].map((part) => sum(weights.map((w, i) => (w / total) * part(angle(i)))));
  return `oklch(0.66 ${(0.04 + 0.16 * Math.hypot(x, y)).toFixed(3)} ${((Math.atan2(y, x) * 180) / Math.PI).toFixed(0)})`;
}

/** A row of a name, a bar in the colour of objective i of d, and a text. */
const barOf = (name, i, d, text = "", width = "0", ...inside) =>
  element("div", { class: "bar", style: `--hue: ${colourOf(times(d, (k) => Number(k === i)))}` }, element("span", {}, name),
    element("span", {}, element("i", { style: `width: ${width}` }), ...inside), element("output", {}, text));

class Stage {
  constructor(page) {
    Object.assign(this, { page, taken: {}, rider: 0, wishes: {} });
    this.map = new DriveMap(byId("stage-map"));
    this.player = new Player((position) => this.tick(position), true);
    this.controls = new Controls(byId("pad"), byId("thumb"), () => this.wake());
    const actions = { world: () => this.open(), seed: () => this.begin(), other: () => this.begin(), again: () => this.begin(),
      next: () => this.next(), share: () => copy(location.href.split("#")[0] + this.link(), "link", byId("shared")),
      "share-command": () => copy(`mo-deepdrive replay '${this.link()}'`, "command", byId("shared")) };
    for (const [id, action] of Object.entries(actions)) on(id, () => action().catch(showError));
    window.addEventListener("keydown", (event) => {
      if (!byId("stage").hidden && !isWriting(event)) ({ r: actions.again, n: actions.next })[event.key]?.().catch(showError);
    });
  }

  get facts() { return this.world.facts; }
  get human() { return this.mode !== "preference"; }
  link() { return linkOfDrive(this.episode, this.human ? "human" : this.choice); }
  /** Show a tab: "drive", "preference" or "against"; `kept` is the drive of a link. */
  async show(mode, kept = null) {
    this.mode = mode;
    byId("stage").setAttribute("aria-labelledby", `tab-${mode}`);
    byId("stage").dataset.mode = mode;
    const needed = { preference: "conditioned", against: "rivals" }[mode];
    this.rows = this.page.worlds.filter((row) => !needed || row[needed]);
    fill("world", options(this.rows.map(({ title }) => title)));
    byId("world").value = Math.max(this.rows.findIndex(({ name }) => name === (this.taken[mode] ?? this.row?.name)), 0);
    await this.open(kept);
  }

  async open(kept = null) {
    this.player.stop();
    this.row = this.rows[byId("world").value];
    this.taken[this.mode] = this.row.name;
    this.world = await World.make(this.row);
    const { facts, mode } = this;
    const alone = facts.vehicles === 1;
    this.seeds = kept && !facts.seeds.includes(kept.seed) ? [kept.seed, ...facts.seeds] : facts.seeds;
    fill("seed", options(this.seeds.map((_, k) => String(k + 1))));
    byId("seed").value = Math.max(this.seeds.indexOf(kept?.seed), 0);
    this.rider = 0;
    this.wishes[facts.id] ??= times(facts.vehicles, (v) =>
      facts.objectives.map((__, i) => (alone ? 50 : i === v % facts.objectives.length ? 100 : 10)));
    // Policies by what they are called: of several vehicles each may have a network of its own.
    const fit = facts.policies.filter(({ conditioned }) => mode !== "preference" || conditioned);
    const ghosts = alone && mode === "against" && facts.ghost ? ["the best known drive"] : [];
    this.choices = [...new Set([...ghosts, ...fit.map(({ label }) => label)])];
    fill("other", options(this.choices));
    say({ "other-label": alone && mode === "against" ? "Ghost" : "Policy" });
    const single = alone && mode === "drive";
    hide({ "sampled-choice": single, "other-choice": single || this.choices.length < 2, wishes: mode !== "preference" });
    this.makeWishes();
    await this.begin(kept);
  }

  next() { byId("seed").value = (Number(byId("seed").value) + 1) % this.seeds.length; return this.begin(); }
  /** Weights (d) of the world's objectives, in units of their scales, that add up to 1. */
  weights(v) { const wish = this.wishes[this.facts.id][v]; return wish.map((each) => each / (sum(wish) || 1)); }

  makeWishes() {
    const { facts, rider } = this;
    const share = (i) => percent(this.weights(rider)[i]);
    hide({ riders: facts.vehicles < 2 });
    fill("riders", times(facts.vehicles, (v) => element("button", { type: "button", "aria-pressed": String(v === rider),
      style: `border-color: ${colourOf(this.weights(v))}`, onclick: () => {
        this.rider = v;
        this.makeWishes();
        this.showBars();
      } }, String(v))));
    fill("wish-sliders", facts.objectives.map(({ name }, i) => slider({
      id: `wish-${i}`, label: name, value: this.wishes[facts.id][rider][i], max: 100, step: 1, text: () => share(i),
      change: (value) => {
        this.wishes[facts.id][rider][i] = value;
        byId("wish-sliders").querySelectorAll("output").forEach((output, k) => (output.textContent = share(k)));
        const colour = colourOf(this.weights(rider));
        byId("riders").children[rider].style.borderColor = colour;
        this.map.paint(rider, colour);
      } })));
  }
  /** The policy of a name as the driver of a vehicle, if it can; under the preference of the page where it is shown. */
  async driver(name, v) {
    const { facts } = this;
    const row = facts.policies.find(({ label, vehicles }) => label === name && vehicles.includes(v));
    if (!row) return byActions([]);
    const actor = new Actor(await load(row.file));
    const wish = () => {
      const asked = actor.objectives.map((key) => this.weights(v)[facts.objectives.findIndex((each) => each.key === key)] ?? 0);
      return this.human && actor.preference ? actor.preference : asked.map((weight) => weight / (sum(asked) || 1));
    };
    return byActor(actor, facts, wish, () => byId("sampled").checked);
  }

  async begin(kept = null) {
    this.player.stop();
    const token = (this.token = {});
    const { facts, human, mode } = this;
    const choice = this.choices[byId("other").value] ?? "";
    const seed = this.seeds[byId("seed").value];
    const place = facts.seeds.indexOf(seed);
    const vehicles = times(facts.vehicles, (v) => v);
    const drivers = await Promise.all(vehicles.map((v) => {
      if (kept) return byActions(decodeActions(kept.actions[v]));
      if (human && v === 0) return byKeys(() => this.controls.take());
      return this.driver(choice, v);
    }));
    const rival = mode !== "against" || facts.vehicles > 1 ? null : facts.policies.some(({ label }) => label === choice)
      ? await this.driver(choice, 0) : byActions(decodeActions(facts.ghost[Math.max(place, 0)]));
    const ghost = rival && new Episode(await World.make(this.row), seed, [rival]);
    if (token !== this.token) return; // another drive has begun meanwhile
    Object.assign(this, { choice, ghost, place, replaying: Boolean(kept), waiting: human && !kept, from: 0 });
    this.episode = new Episode(this.world, seed, drivers);
    const colours = vehicles.map((v) => (human ? series(Math.min(v, 1)) : colourOf(this.weights(v))));
    this.map.show(this.episode.scene, [{ label: human ? "you" : choice, drive: this.episode, colours },
      ...(ghost ? [{ label: choice, drive: ghost, ghost: true }] : [])]);
    this.map.move(0);
    hide({ prompt: !this.waiting, outcome: true });
    say({ "bars-heading": human ? "What you earn" : "What it earns" });
    this.full = facts.objectives.map(({ scale }, i) =>
      Math.max(...facts.drivers.map(({ returns }) => Math.abs(returns[Math.max(place, 0)][i])), 0.2 * scale));
    fill("bars", facts.objectives.map(({ name }, i) => barOf(name, i, facts.objectives.length)));
    this.showBars();
    this.player.play(0, Infinity, facts.frequency);
  }
  /** A key or a thumb asks for something; whether anyone is listening. */
  wake() {
    const here = !byId("stage").hidden && this.human && this.episode && !this.replaying;
    if (here) this.waiting = false;
    return here;
  }

  tick(now) {
    if (this.waiting && this.controls.gamepad().some(Boolean)) this.wake();
    hide({ prompt: !this.waiting });
    if (this.waiting) { this.from = now; return; }
    const { episode, ghost } = this;
    const [position, before] = [now - this.from, episode.decisions];
    for (const each of ghost ? [episode, ghost] : [episode]) while (!each.over && each.decisions < position) each.step();
    if (episode.decisions > before) this.showBars();
    if (episode.decisions > before || ghost) this.map.extend();
    const last = Math.max(episode.decisions, ghost?.decisions ?? 0);
    this.map.move(Math.min(position, last));
    const [{ end, decisions }] = episode.vehicles;
    if (this.human && end && position >= decisions && byId("outcome").hidden) this.showOutcome();
    if (!episode.over || position < last) return;
    if (this.human) this.player.stop();
    else if (position > last + HOLD * this.facts.frequency) this.next().catch(showError);
  }

  showBars() {
    const { facts, episode, world } = this;
    const shown = this.human ? 0 : this.rider;
    [...byId("bars").children].forEach((bar, i) => {
      const value = episode.returns[shown][i];
      bar.querySelector("i").style.width = percent(Math.min(Math.abs(value) / this.full[i], 1));
      bar.lastChild.textContent = withUnit(formatted(value, 4 * this.full[i]), facts.objectives[i].unit);
    });
    say({ seconds: `${(episode.decisions / facts.frequency).toFixed(1)} s`,
      speedometer: `${(3.6 * world.of(shown, "speed")).toFixed(0)} km/h` });
  }

  showOutcome() {
    const { facts, episode, place } = this;
    const [[mine], [{ end, decisions }]] = [episode.returns, episode.vehicles];
    const rivals = place < 0 ? [] : facts.drivers.map(({ label, returns, ends }) => ({ label, returns: returns[place], end: ends[place] }));
    const others = [...facts.front.map(({ name, returns }) => ({ label: name, returns })), ...rivals];
    const better = ({ returns }) => (mine.every((value, i) => returns[i] >= value)
      ? facts.objectives.filter((_, i) => returns[i] > mine[i]).map(({ name }) => name) : []);
    const above = others.find((row) => better(row).length);
    const verdict = above ? `${above.label} is nowhere worse, and better in ${better(above).join(", ")}.`
      : "Nobody on this page is better in one objective without being worse in another.";
    say({ "outcome-heading": `${capital(plain(end))} after ${(decisions / facts.frequency).toFixed(1)} s`, shared: "", verdict: capital(verdict) });
    const own = { label: "your preference", weights: this.weights(0).map((w, i) => w / facts.objectives[i].scale) };
    const utilities = [own, ...facts.utilities];
    const worth = ({ returns }, { weights }) => sum(returns.map((value, i) => value * weights[i]));
    const rows = [{ label: "you", returns: mine, end }, ...rivals].sort((a, b) => worth(b, own) - worth(a, own));
    fillTable(byId("rivals"), ["", ...utilities.map(({ label }) => label), ...facts.objectives.map(titled), "end"],
      rows.map((row) => element("tr", { class: row.label === "you" ? "chosen" : "" }, element("th", { scope: "row" }, row.label),
        ...cells([...utilities.map((utility) => formatted(worth(row, utility), 1)),
          ...row.returns.map((value, i) => formatted(value, 4 * this.full[i])), plain(row.end)]))));
    this.showStanding(others.map(({ returns }) => returns), mine);
    hide({ outcome: false });
    byId("outcome").scrollIntoView({ block: "nearest", behavior: "smooth" });
  }
  /** All drives in parallel coordinates, further up is better. */
  showStanding(others, mine) {
    const { objectives } = this.facts;
    const x = (i) => 30 + (i * 240) / Math.max(objectives.length - 1, 1);
    const ends = objectives.map((_, i) => [Math.min, Math.max].map((most) => most(...[...others, mine].map((row) => row[i]))));
    const y = (value, i) => 92 - 84 * (ends[i][1] > ends[i][0] ? (value - ends[i][0]) / (ends[i][1] - ends[i][0]) : 0.5);
    const line = (row, attributes) => polyline(row.map((value, i) => [x(i), y(value, i)]), attributes);
    byId("standing").replaceChildren(...objectives.map((_, i) => polyline([[x(i), 8], [x(i), 92]], { stroke: "var(--line)" })),
      ...others.map((row) => line(row, { stroke: "var(--front)", "stroke-opacity": 0.6 })),
      line(mine, { stroke: "var(--accent)", "stroke-width": 2.5 }),
      ...objectives.map(({ name }, i) => svg("text", { x: x(i), y: i % 2 ? 114 : 105 }, name)));
  }
}
