// Runs the page's own code in Node: node page.mjs WHAT FOLDER NAME INPUT OUTPUT, with the worlds and policies of FOLDER.
//   world: drives NAME by INPUT, {seed, actions: [[V] per decision]}, and restarts after every episode; OUTPUT has the
//          observations, rewards and worlds after every decision, byte by byte
//   actor: OUTPUT has the network's outputs for INPUT, [[observation, accrued, discount, preference], ...]
//   link:  drives NAME by INPUT, {seed, actions: [[V] per decision]}; OUTPUT is {link, returns, ends}
import fs from "fs";

const [what, folder, name, input, output] = process.argv.slice(2);
const source = (file) => fs.readFileSync(new URL(`../../algorithms/reporting/page/${file}`, import.meta.url), "utf8");
const read = (path) => JSON.parse(fs.readFileSync(path));
const shared = `class Refusal extends Error {}
  const sum = (numbers) => numbers.reduce((a, b) => a + b, 0);
  const times = (count, make) => Array.from({ length: count }, (_, k) => make(k));
  const VERSION = "";`;
const page = new Function(`${shared}\n${source("world.js")}\nreturn { World, Actor, Episode, linkOfDrive };`)();
const asked = read(input);

function makeWorld() {
  const module = new WebAssembly.Module(fs.readFileSync(`${folder}/${name}.wasm`));
  const maths = WebAssembly.Module.imports(module).map((one) => [one.name, Math[one.name]]);
  const run = new WebAssembly.Instance(module, { env: Object.fromEntries(maths) }).exports;
  return new page.World(read(`${folder}/${name}.json`), run);
}

function driveAndRestart() {
  const world = makeWorld(), file = fs.openSync(output, "w");
  world.run.seed(BigInt(asked.seed));
  world.run.restart();
  for (const chosen of asked.actions) {
    world.actions.set(chosen);
    if (world.run.step()) throw new Error("refused");
    for (const part of [world.observations, world.rewards, world.records]) {
      fs.writeSync(file, new Uint8Array(part.buffer, part.byteOffset, part.byteLength));
    }
    if (chosen.every((_, v) => world.over(v))) world.run.restart();
  }
}

function keepDrive() {
  const drivers = asked.actions[0].map((_, v) => ({ act: (world, who, step) => asked.actions[step][v] }));
  const episode = new page.Episode(makeWorld(), asked.seed, drivers);
  while (!episode.over) episode.step();
  const ends = episode.vehicles.map(({ end }) => end);
  fs.writeFileSync(output, JSON.stringify({ link: page.linkOfDrive(episode, "you"), returns: episode.returns, ends }));
}

function think() {
  const actor = new page.Actor(read(`${folder}/${name}.json`));
  fs.writeFileSync(output, JSON.stringify(asked.map((parts) => Array.from(actor.outputs(...parts)))));
}

({ world: driveAndRestart, actor: think, link: keepDrive })[what]();
