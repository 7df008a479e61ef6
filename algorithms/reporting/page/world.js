// Worlds as WebAssembly modules, networks that drive in them, and links that keep a drive.

const WORLD_FORMAT = 1;
const AGAIN = "Open the page again from one installation: mo-deepdrive play --web.";
const answers = new Map();

/** What a file beside the page holds, asked for once. */
function load(name, kind = "json") {
  const ask = async () => {
    const answer = await fetch(name).catch(() => null);
    if (!answer?.ok) throw new Refusal(`The file ${name} is missing beside this page. ${AGAIN}`);
    return answer[kind]();
  };
  if (!answers.has(name)) answers.set(name, ask());
  return answers.get(name);
}

const bytesOf = (text) => Uint8Array.from(atob(text), (character) => character.charCodeAt(0));

/** One world in memory of its own, of a module that mo_deepdrive/device/wasm.py describes. */
class World {
  /** Of a row of page.json; what the page says of the world is in `facts`. */
  static async make(row) {
    if (!globalThis.WebAssembly) throw new Refusal("This browser has no WebAssembly. Open the page in a current Firefox, Chrome or Safari.");
    const [facts, bytes] = await Promise.all([load(row.json), load(row.wasm, "arrayBuffer")]);
    if (facts.format !== WORLD_FORMAT || facts.version !== VERSION) {
      throw new Refusal(`The module of ${row.title} is of version ${facts.version}, this page of ${VERSION}. ${AGAIN}`);
    }
    const module = await WebAssembly.compile(bytes);
    const maths = WebAssembly.Module.imports(module).map(({ name }) => [name, name === "fmod" ? (a, b) => a % b : Math[name]]);
    return new World(facts, (await WebAssembly.instantiate(module, { env: Object.fromEntries(maths) })).exports);
  }

  constructor(facts, run) {
    const [count, d, size] = [facts.vehicles, facts.objectives.length, facts.observations.length];
    const view = (Kind, name, length) => new Kind(run.memory.buffer, run[name].value, length);
    Object.assign(this, {
      facts, run, count, d, size, actions: view(Int32Array, "actions", count),
      observations: view(Float32Array, "observations", size * count), rewards: view(Float32Array, "rewards", d * count),
      ended: view(Uint8Array, "ended", count), timedOut: view(Uint8Array, "timed_out", count),
      records: new DataView(run.memory.buffer, run.worlds.value, count * facts.state.size) });
  }

  number(at, [offset, type], k = 0) {
    if (type === "b1") return this.records.getUint8(at + offset + k);
    return type === "f8" ? this.records.getFloat64(at + offset + 8 * k, true) : Number(this.records.getBigInt64(at + offset + 8 * k, true));
  }

  of(v, name, k = 0) { return this.number(v * this.facts.state.size, this.facts.state.fields[name], k); }
  over(v) { return Boolean(this.ended[v] || this.timedOut[v]); }
  /** The pose of a car with a scripted driver, of undefined numbers while it is absent. */
  car(j) {
    const { offset, size, fields } = this.facts.cars;
    const of = (name) => this.number(offset + j * size, fields[name]);
    return of("present") ? { x: of("x"), y: of("y"), heading: Math.atan2(of("sin_heading"), of("cos_heading")) } : {};
  }
  /** What the map shows of the episode that has begun. */
  scene() {
    const { scene, obstacles } = this.facts;
    const routes = times(this.count, (v) => (scene.roads.length ? [scene.roads[this.of(v, "route")].line.at(-1)]
      : times(this.of(v, "n_waypoints"), (k) => times(2, (axis) => this.of(v, "waypoints", 2 * k + axis)))));
    const end = (k) => times(2, (axis) => this.number(0, [obstacles.offset, "f8"], 2 * k + axis));
    // Where there are no roads, of the map only what is between start and destination.
    const points = [...routes.flat(), ["x", "y"].map((name) => this.of(0, name))];
    const ends = times(2, (axis) => [Math.min, Math.max].map((most) => most(...points.map((at) => at[axis]))));
    const size = 18 + Math.max(...ends.map(([low, high]) => high - low));
    const box = scene.lanes || scene.roads.length ? scene.box : [...ends.map(([low, high]) => (low + high - size) / 2), size];
    return { ...scene, box, routes, obstacles: times(obstacles.count ?? 0, (k) => [end(2 * k), end(2 * k + 1)]) };
  }
}

/** A network of the zoo. */
class Actor {
  constructor(facts) {
    Object.assign(this, facts);
    const numbers = new Float32Array(bytesOf(facts.weights).buffer);
    let at = 0;
    this.parts = facts.layers.map(([out, width]) => {
      const [matrix, biases] = [[at, at += out * width], [at, at += out]].map((ends) => numbers.subarray(...ends));
      return { out, width, matrix, biases };
    });
  }

  outputs(observation, accrued, discount, preference) {
    const parts = { observation, accrued, discount: [discount], preference };
    let values = this.inputs.flatMap((name) => [...parts[name]]).map((value, i) => value / this.scales[i]);
    const bent = this.activation === "tanh" ? Math.tanh : (value) => Math.max(value, 0);
    this.parts.forEach(({ out, width, matrix, biases }, layer) => {
      const next = times(out, (k) => values.reduce((total, value, i) => total + value * matrix[k * width + i], biases[k]));
      values = layer < this.parts.length - 1 ? next.map(bent) : next;
    });
    return values;
  }
  /** The greedy action, or one drawn by the probabilities of the logits. */
  action(outputs, sampled) {
    const most = Math.max(...outputs);
    if (!sampled) return outputs.indexOf(most);
    const shares = outputs.map((value) => Math.exp(value - most));
    let rest = Math.random() * sum(shares);
    return Math.max(shares.findIndex((share) => (rest -= share) < 0), 0);
  }
}

/** Who drives a vehicle: by `keys()` that are held, by actions one after the other, or by a network. */
const byKeys = (keys) => ({ act: (world, v) => world.run.keys(v, ...keys().map(Number)) });
const byActions = (actions) => ({ act: (_, __, step) => actions[step] ?? 0 });

/** `wish()` gives the weights of the network's objectives, `sampled()` whether its actions are drawn. */
function byActor(actor, facts, wish, sampled) {
  const columns = actor.objectives.map((key) => facts.objectives.findIndex((objective) => objective.key === key));
  const accrued = columns.map(() => 0);
  let discount = 1;
  return {
    act(world, v) {
      const observation = world.observations.subarray(v * world.size, (v + 1) * world.size);
      return actor.action(actor.outputs(observation, accrued, discount, wish()), sampled());
    }, add(rewards) {
      columns.forEach((column, i) => (accrued[i] += discount * rewards[column]));
      discount *= actor.gamma;
    }, };
}

/** An episode as it is driven: what DriveMap shows, the actions, and the returns so far (V, d). */
class Episode {
  constructor(world, seed, drivers) {
    const [returns, actions] = [drivers.map(() => Array(world.d).fill(0)), drivers.map(() => [])];
    Object.assign(this, { world, seed, drivers, decisions: 0, returns, actions });
    world.run.seed(BigInt(seed));
    if (world.run.restart()) throw new Refusal(`Scenario ${seed} of ${world.facts.title} cannot be placed. ${AGAIN}`);
    this.scene = world.scene();
    this.vehicles = drivers.map(() => ({ x: [], y: [], heading: [], decisions: 0, end: "" }));
    this.cars = times(world.facts.cars.count ?? 0, () => ({ x: [], y: [], heading: [] }));
    this.record(() => true);
  }

  get over() { return this.vehicles.every(({ end }) => end); }

  record(moved) {
    const { world } = this;
    this.vehicles.forEach((track, v) => {
      if (!moved(v)) return;
      for (const name of ["x", "y", "heading"]) track[name].push(world.of(v, name));
      track.decisions = track.x.length - 1;
      track.end = world.over(v) ? world.facts.ends[world.of(v, "end")] : "";
    });
    this.cars.forEach((track, j) => {
      const pose = world.car(j);
      const turns = Math.round((track.heading.at(-1) - pose.heading) / (2 * Math.PI));
      pose.heading += 2 * Math.PI * (turns || 0); // on the shortest way from the last one
      for (const name of ["x", "y", "heading"]) track[name].push(pose[name]);
    });
  }

  step() {
    const { world } = this;
    const driving = this.vehicles.map(({ end }) => !end);
    this.drivers.forEach((driver, v) => {
      const action = driving[v] ? driver.act(world, v, this.decisions) : 0;
      if (driving[v]) this.actions[v].push(action);
      world.actions[v] = action;
    });
    if (world.run.step()) throw new Refusal("This drive has an action that the scenario does not have.");
    this.decisions += 1;
    this.drivers.forEach((driver, v) => {
      const rewards = world.rewards.subarray(v * world.d, (v + 1) * world.d);
      rewards.forEach((reward, i) => (this.returns[v][i] += reward));
      driver.add?.(rewards);
    });
    this.record((v) => driving[v]);
  }
}

/** Discrete actions as runs of equal ones, "d12a": mo_deepdrive/world/action_sequences.py. */
function encodeActions(actions) {
  const letters = actions.map((action) => String.fromCharCode(97 + action)).join("");
  return letters.replace(/(.)\1+/g, (run, letter) => letter + run.length);
}

const decodeActions = (text) => [...text.matchAll(/([a-z])(\d*)/g)].flatMap(([, letter, count]) =>
  Array(Number(count || 1)).fill(letter.charCodeAt(0) - 97));

function checksum(text) {
  let crc = -1;
  for (const character of text) {
    crc ^= character.charCodeAt(0);
    for (let bit = 0; bit < 8; bit++) crc = (crc >>> 1) ^ (crc & 1 ? 0xedb88320 : 0);
  }
  return (~crc >>> 0).toString(16).padStart(8, "0");
}

function linkOfDrive(episode, driver) {
  const { id, arguments: given, version } = episode.world.facts;
  const kept = { format: 1, version, id, arguments: given, seed: episode.seed, driver, actions: episode.actions.map(encodeActions) };
  const text = String.fromCharCode(...new TextEncoder().encode(JSON.stringify(kept)));
  const payload = btoa(text).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
  return `#drive=${payload}.${checksum(payload)}`;
}

function driveOfLink(hash) {
  const [payload, check] = hash.replace(/^#drive=/, "").split(".");
  if (checksum(payload) !== check) throw new Refusal("This link was cut or edited. Copy the whole link again.");
  const kept = JSON.parse(new TextDecoder().decode(bytesOf(payload.replaceAll("-", "+").replaceAll("_", "/"))));
  if (kept.format !== 1 || kept.version !== VERSION) {
    throw new Refusal(`This link is of version ${kept.version}, this page of ${VERSION}. Open it with the page of its version.`);
  }
  return kept;
}
