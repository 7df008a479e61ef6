// The tabs on which someone drives: a person, a network under preferences, or both.

const KEYS = { ArrowUp: 0, w: 0, ArrowDown: 1, s: 1, ArrowLeft: 2, a: 2, ArrowRight: 3, d: 3 };
const HOLD = 1.5; // s for which the last picture of a drive without a person stays

/** What keys, thumb and gamepad ask for: accelerate, brake, left, right. */
class Controls {
  constructor(pad, thumb, wake) {
    Object.assign(this, { pad, thumb, wake, held: new Set(), tapped: new Set(), drag: [] });
    window.addEventListener("keydown", (event) => this.key(event, true));
    window.addEventListener("keyup", (event) => this.key(event, false));
    window.addEventListener("blur", () => this.held.clear());
    pad.addEventListener("pointerdown", (event) => {
      pad.setPointerCapture(event.pointerId);
      this.from = [event.clientX, event.clientY];
      this.move(event);
    });
    pad.addEventListener("pointermove", (event) => this.from && this.move(event));
    for (const name of ["pointerup", "pointercancel"]) pad.addEventListener(name, () => this.move(null));
  }

  key(event, down) {
    const key = KEYS[event.key] ?? KEYS[event.key.toLowerCase()];
    const writing = /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName) || event.ctrlKey || event.metaKey || event.altKey;
    if (!down) this.held.delete(key);
    if (!down || writing || key === undefined || !this.wake()) return;
    event.preventDefault();
    this.held.add(key);
    this.tapped.add(key);
  }

  move(event) {
    const [x, y] = event ? [event.clientX - this.from[0], event.clientY - this.from[1]] : [0, 0];
    if (!event) this.from = null;
    const dead = 14; // pixels
    this.drag = [y < -dead, y > dead, x < -dead, x > dead];
    this.thumb.style.transform = `translate(${Math.max(-60, Math.min(x, 60))}px, ${Math.max(-50, Math.min(y, 50))}px)`;
    if (this.drag.some(Boolean)) this.wake();
  }

  gamepad() {
    const pad = [...(navigator.getGamepads?.() ?? [])].find(Boolean);
    const asked = pad ? [pad.buttons[7]?.pressed || pad.buttons[0]?.pressed, pad.buttons[6]?.pressed || pad.buttons[1]?.pressed,
      pad.axes[0] < -0.3, pad.axes[0] > 0.3] : [];
    if (asked.some(Boolean)) this.wake();
    return asked;
  }

  /** What has been asked for since the last call: a short press is not lost. */
  take() {
    const pad = this.gamepad();
    const asked = [0, 1, 2, 3].map((key) => Boolean(this.held.has(key) || this.tapped.has(key) || this.drag[key] || pad[key]));
    this.tapped.clear();
    return asked;
  }
}

/** Colour of weights (d): the hues of the objectives, mixed. */
function colourOf(weights) {
  const angle = (i) => (2 * Math.PI * (i + 0.1)) / weights.length;
  const total = sum(weights) || 1;
  const [x, y] = [Math.cos, Math.sin].map((part) => sum(weights.map((w, i) => (w / total) * part(angle(i)))));
  return `oklch(0.66 ${(0.04 + 0.16 * Math.hypot(x, y)).toFixed(3)} ${((Math.atan2(y, x) * 180) / Math.PI).toFixed(0)})`;
}

class Stage {
  constructor(page) {
    Object.assign(this, { page, mode: "drive", taken: {}, rider: 0, wishes: {} });
    this.map = new DriveMap(byId("stage-map"));
    this.controls = new Controls(byId("pad"), byId("thumb"), () => this.wake());
    const change = (id, action) => byId(id).addEventListener(byId(id).tagName === "BUTTON" ? "click" : "change", action);
    change("world", () => this.open());
    change("seed", () => this.begin());
    change("other", () => this.begin());
    change("again", () => this.begin());
    change("next", () => this.next());
    change("share", () => copy(location.href.split("#")[0] + this.link(), "link", byId("shared")));
    change("share-command", () => copy(`mo-deepdrive replay '${this.link()}'`, "command", byId("shared")));
    window.addEventListener("keydown", ({ key, target, ctrlKey, metaKey }) => {
      if (byId("stage").hidden || ctrlKey || metaKey || target.tagName === "SELECT") return;
      if (key === "r") this.begin();
      if (key === "n") this.next();
    });
  }

  get facts() {
    return this.world.facts;
  }

  get human() {
    return this.mode !== "preference";
  }

  link() {
    return linkOfDrive(this.episode, this.human ? "human" : this.actors[0]?.name ?? "human");
  }

  // --------------------------------------------------------------------------------------------- who drives, and where

  /** Show a tab: "drive", "preference" or "against"; `kept` is the drive of a link. */
  async show(mode, kept = null) {
    this.mode = mode;
    byId("stage").setAttribute("aria-labelledby", `tab-${mode}`);
    byId("stage").dataset.mode = mode;
    const fit = { drive: () => true, preference: ({ conditioned }) => conditioned, against: ({ rivals }) => rivals }[mode];
    this.rows = this.page.worlds.filter(fit);
    byId("world").replaceChildren(...options(this.rows.map(({ title }) => title)));
    const same = this.rows.findIndex(({ name }) => name === (this.taken[mode] ?? this.row?.name));
    byId("world").value = Math.max(same, 0);
    await this.open(kept);
  }

  async open(kept = null) {
    this.stop();
    this.row = this.rows[byId("world").value];
    this.taken[this.mode] = this.row.name;
    this.world = await World.make(this.row, this.page.version);
    const { facts, mode } = this;
    this.seeds = kept?.actions && !facts.seeds.includes(kept.seed) ? [kept.seed, ...facts.seeds] : facts.seeds;
    byId("seed").replaceChildren(...options(this.seeds.map((_, k) => String(k + 1))));
    byId("seed").value = Math.max(this.seeds.indexOf(kept?.seed), 0);
    this.wishes[facts.id] ??= Array.from({ length: facts.vehicles }, (_, v) =>
      facts.objectives.map((__, i) => (facts.vehicles > 1 && i === v % facts.objectives.length ? 100 : 30)));
    const fit = facts.policies.filter(({ conditioned }) => mode !== "preference" || conditioned);
    const ghosts = facts.vehicles === 1 && mode === "against" && facts.ghost ? ["the best known drive"] : [];
    this.choices = [...ghosts.map((label) => ({ label })), ...fit];
    byId("other").replaceChildren(...options(this.choices.map(({ label }) => label)));
    byId("other-label").textContent = facts.vehicles === 1 && mode === "against" ? "Ghost" : "Policy";
    byId("other-choice").hidden = this.choices.length < 2 || (mode === "drive" && facts.vehicles === 1);
    byId("sampled-choice").hidden = mode === "drive" && facts.vehicles === 1;
    byId("wishes").hidden = mode !== "preference";
    this.makeWishes();
    await this.begin(kept);
  }

  next() {
    byId("seed").value = (Number(byId("seed").value) + 1) % this.seeds.length;
    return this.begin();
  }

  /** Weights (d) of the world's objectives per unit of their scales, of a vehicle, that add up to 1. */
  weights(v) {
    const wish = this.wishes[this.facts.id][v];
    return wish.map((each) => each / (sum(wish) || 1));
  }

  makeWishes() {
    const { facts } = this;
    const all = this.wishes[facts.id];
    byId("riders").hidden = facts.vehicles < 2;
    byId("riders").replaceChildren(...all.map((_, v) => element("button", { type: "button", "aria-pressed": v === this.rider,
      style: `border-color: ${colourOf(this.weights(v))}`, onclick: () => {
        this.rider = v;
        this.makeWishes();
        this.showBars();
      } }, String(v))));
    byId("wish-sliders").replaceChildren(...facts.objectives.map(({ name, key }, i) => slider({
      id: `wish-${i}`, label: name, value: all[this.rider][i], max: 100, step: 1,
      text: () => percent(this.weights(this.rider)[i]),
      change: (value) => {
        all[this.rider][i] = value;
        byId("wish-sliders").querySelectorAll("input").forEach((input, k) => {
          input.previousElementSibling.textContent = percent(this.weights(this.rider)[k]);
        });
        this.map.paint(this.rider, colourOf(this.weights(this.rider)));
      },
    })));
  }

  async actor(choice, facts, v) {
    const actor = new Actor(await load(choice.file));
    const wish = () => {
      const weights = actor.objectives.map((key) => this.weights(v)[facts.objectives.findIndex((each) => each.key === key)] ?? 0);
      return this.human ? actor.preference ?? weights : weights.map((weight) => weight / (sum(weights) || 1));
    };
    return byActor(actor, facts, wish, () => byId("sampled").checked);
  }

  async begin(kept = null) {
    this.stop();
    const token = (this.token = {});
    const { facts, mode } = this;
    const choice = this.choices[byId("other").value];
    const seed = this.seeds[byId("seed").value];
    const place = facts.seeds.indexOf(seed);
    const vehicles = Array.from({ length: facts.vehicles }, (_, v) => v);
    this.actors = choice?.file ? [choice] : [];
    const drivers = await Promise.all(vehicles.map((v) => {
      if (kept?.actions) return byActions(decodeActions(kept.actions[v]));
      if (this.human && v === 0) return byKeys(() => this.controls.take());
      return choice?.file ? this.actor(choice, facts, v) : byActions([]);
    }));
    this.ghost = null;
    if (mode === "against" && facts.vehicles === 1 && choice && (choice.file || place >= 0)) {
      const driver = choice.file ? await this.actor(choice, facts, 0) : byActions(decodeActions(facts.ghost[place]));
      this.ghost = new Episode(await World.make(this.row, this.page.version), seed, [driver]);
    }
    if (token !== this.token) return; // another drive has begun meanwhile
    this.episode = new Episode(this.world, seed, drivers);
    this.replaying = Boolean(kept?.actions);
    const drives = [{ label: mode === "preference" ? "the policy" : "you", drive: this.episode,
      ...(mode === "preference" ? { colours: vehicles.map((v) => colourOf(this.weights(v))) } : {}) }];
    if (this.ghost) drives.push({ label: choice.label, drive: this.ghost, ghost: true });
    this.map.show(this.episode.scene, drives);
    this.map.move(0);
    this.position = 0;
    this.waiting = this.human && !this.replaying;
    byId("prompt").hidden = !this.waiting;
    byId("outcome").hidden = true;
    byId("bars-heading").textContent = mode === "preference" ? "What it earns" : "What you earn";
    const known = facts.drivers.map(({ returns }) => returns[Math.max(place, 0)]);
    this.full = facts.objectives.map(({ scale }, i) => Math.max(...known.map((row) => Math.abs(row[i])), 0.2 * scale));
    byId("bars").replaceChildren(...facts.objectives.map((objective, i) => element("div", { class: "bar",
      style: `--hue: ${colourOf(facts.objectives.map((_, k) => Number(k === i)))}` },
    element("span", {}, objective.name), element("span", {}, element("i")), element("output"))));
    this.showBars();
    this.from = performance.now();
    this.request = requestAnimationFrame((now) => this.frame(now));
  }

  // ------------------------------------------------------------------------------------------------------- as time goes

  /** A key or a thumb asks for something; whether anyone is listening. */
  wake() {
    const here = !byId("stage").hidden && this.human && this.episode && !this.replaying;
    if (here) this.waiting = false;
    return here;
  }

  stop() {
    cancelAnimationFrame(this.request);
  }

  frame(now) {
    const seconds = Math.min(Math.max(now - this.from, 0), 200) / 1000;
    this.from = now;
    this.request = requestAnimationFrame((later) => this.frame(later));
    if (this.waiting) {
      this.controls.gamepad();
      return;
    }
    byId("prompt").hidden = true;
    this.position += seconds * this.facts.frequency;
    const { episode, ghost } = this;
    const before = episode.decisions;
    try {
      while (!episode.over && episode.decisions < this.position) episode.step();
      while (ghost && !ghost.over && ghost.decisions < this.position) ghost.step();
    } catch (error) {
      this.stop();
      showError(error);
      return;
    }
    if (episode.decisions > before) this.showBars();
    if (episode.decisions > before || ghost) this.map.extend();
    this.map.move(episode.over ? Math.min(this.position, Math.max(episode.decisions, ghost?.decisions ?? 0)) : this.position);
    if (!episode.over || this.position < episode.decisions) return;
    if (byId("outcome").hidden && (this.human || this.replaying)) this.showOutcome();
    if (this.human && (!ghost || ghost.over)) this.stop();
    if (!this.human && this.position > episode.decisions + HOLD * this.facts.frequency) this.next();
  }

  showBars() {
    const { facts, episode, world } = this;
    const shown = this.mode === "preference" ? this.rider : 0;
    [...byId("bars").children].forEach((bar, i) => {
      const value = episode.returns[shown][i];
      bar.querySelector("i").style.width = percent(Math.min(Math.abs(value) / this.full[i], 1));
      bar.lastChild.textContent = withUnit(formatted(value, 4 * this.full[i]), facts.objectives[i].unit);
    });
    byId("seconds").textContent = `${(episode.decisions / facts.frequency).toFixed(1)} s`;
    byId("speedometer").textContent = `${(3.6 * world.of(shown, "speed")).toFixed(0)} km/h`;
  }

  // ------------------------------------------------------------------------------------------------------- what it earned

  showOutcome() {
    const { facts, episode } = this;
    const [mine] = episode.returns;
    const end = plain(episode.vehicles[0].end);
    const seconds = (episode.vehicles[0].decisions / facts.frequency).toFixed(1);
    byId("outcome-heading").textContent = end === "arrived" ? `Arrived after ${seconds} s` : `${seconds} s: ${end}`;
    const place = facts.seeds.indexOf(episode.seed);
    const rivals = place < 0 ? [] : facts.drivers.map(({ label, returns, ends }) => ({ label, returns: returns[place], end: ends[place] }));
    const better = (row) => mine.every((value, i) => row.returns[i] >= value) && facts.objectives.filter((_, i) => row.returns[i] > mine[i]);
    const above = [...rivals, ...facts.front.map(({ name, returns }) => ({ label: name, returns }))].find((row) => better(row).length);
    byId("verdict").textContent = above
      ? `${above.label} is nowhere worse, and better in ${better(above).map(({ name }) => name).join(", ")}.`
      : "Nobody on this page is better in one objective without being worse in another.";
    const weights = this.weights(0).map((w, i) => w / facts.objectives[i].scale);
    const utilities = [{ label: "your preference", weights }, ...facts.utilities];
    const worth = (row, utility) => sum(row.map((value, i) => value * utility.weights[i]));
    const rows = [{ label: "you", returns: mine, end: episode.vehicles[0].end }, ...rivals]
      .sort((a, b) => worth(b.returns, utilities[0]) - worth(a.returns, utilities[0]));
    fillTable(byId("rivals"), ["", ...utilities.map(({ label }) => label), ...facts.objectives.map(titled), "end"],
      rows.map(({ label, returns, end: how }) => element("tr", { class: label === "you" ? "chosen" : "" },
        element("th", { scope: "row" }, label), ...cells([...utilities.map((utility) => formatted(worth(returns, utility), 1)),
          ...returns.map((value, i) => formatted(value, 4 * this.full[i])), plain(how)]))));
    this.showStanding([...facts.front.map(({ returns }) => returns), ...rivals.map(({ returns }) => returns)], mine);
    byId("shared").textContent = "";
    byId("outcome").hidden = false;
  }

  /** All drives in parallel coordinates, further up is better. */
  showStanding(others, mine) {
    const { objectives } = this.facts;
    const x = (i) => 30 + (i * 240) / Math.max(objectives.length - 1, 1);
    const ends = objectives.map((_, i) => [Math.min, Math.max].map((most) => most(...[...others, mine].map((row) => row[i]))));
    const y = (value, i) => 92 - 84 * (ends[i][1] > ends[i][0] ? (value - ends[i][0]) / (ends[i][1] - ends[i][0]) : 0.5);
    const line = (row, attributes) => polyline(row.map((value, i) => [x(i), y(value, i)]), attributes);
    byId("standing").setAttribute("viewBox", "0 0 300 116");
    byId("standing").replaceChildren(
      ...objectives.map((_, i) => polyline([[x(i), 8], [x(i), 92]], { stroke: "var(--line)" })),
      ...others.map((row) => line(row, { stroke: "var(--front)", "stroke-opacity": 0.6 })),
      line(mine, { stroke: "var(--accent)", "stroke-width": 2.5 }),
      ...objectives.map(({ name }, i) => svg("text", { x: x(i), y: i % 2 ? 114 : 105 }, name)));
  }
}
