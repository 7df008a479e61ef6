// node drive_module.mjs WASM JSON SEED ACTIONS OUTPUT: drives by ACTIONS, a JSON list of lists of numbers, with a restart
// after every episode; OUTPUT are the observations, rewards and worlds after every decision and its restart, as they are.
import fs from "fs";

const [wasm, json, seed, actions, output] = process.argv.slice(2);
const about = JSON.parse(fs.readFileSync(json));
const module = new WebAssembly.Module(fs.readFileSync(wasm));
const maths = Object.fromEntries(WebAssembly.Module.imports(module).map(({name}) => [name, Math[name]]));
const world = new WebAssembly.Instance(module, {env: maths}).exports;
const bytes = (name, size) => new Uint8Array(world.memory.buffer, world[name].value, size);
const V = about.vehicles;
const outputs = [
  ["observations", 4 * V * about.observations.length],
  ["rewards", 4 * V * about.objectives.length],
  ["worlds", V * about.state.size],
];
const file = fs.openSync(output, "w");
const check = (failed) => { if (failed) throw new Error("refused"); };
world.seed(BigInt(seed));
check(world.restart());
for (const chosen of JSON.parse(fs.readFileSync(actions))) {
  new (about.continuous ? Float32Array : Int32Array)(world.memory.buffer, world.actions.value, chosen.length).set(chosen);
  check(world.step());
  for (const [name, size] of outputs) fs.writeSync(file, bytes(name, size));
  const ended = bytes("ended", V), late = bytes("timed_out", V);
  if (ended.every((one, v) => one || late[v])) check(world.restart());
}
