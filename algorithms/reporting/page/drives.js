// Drives as the simulator recorded them: every picture is a recorded decision, nothing is computed in between.

const SVG = "http://www.w3.org/2000/svg";

/** A stored drive with its readings as numbers: each is the sum of the stored differences up to it. */
function decodeDrive(stored, resolution) {
  const decoded = ({ end, ...readings }) => {
    const vehicle = { end, decisions: readings.x.length - 1 };
    for (const [name, differences] of Object.entries(readings)) {
      let total = 0;
      vehicle[name] = differences.map((step) => (step === null ? null : (total += step) * resolution[name]));
    }
    return vehicle;
  };
  const [vehicles, cars] = [stored.vehicles.map(decoded), stored.cars.map(decoded)];
  return { vehicles, cars, decisions: Math.max(...vehicles.map((vehicle) => vehicle.decisions)) };
}

function svg(name, attributes, ...children) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

/** A closed path through points [x, y]. */
const polygon = (points, attributes) =>
  svg("polygon", { points: points.map((point) => point.join(",")).join(" "), ...attributes });

/** A car that faces up, with its centre at the origin. */
function car(size, attributes) {
  const [length, width] = size;
  const [x, y] = [width / 2, length / 2];
  const body = [[-x, -y + 0.3], [-x + 0.25, -y], [x - 0.25, -y], [x, -y + 0.3], [x, y - 0.7], [x - 0.4, y],
    [-x + 0.4, y], [-x, y - 0.7]];
  const window = [[-x + 0.3, 0.1 * y], [x - 0.3, 0.1 * y], [x - 0.55, 0.42 * y], [-x + 0.55, 0.42 * y]];
  return svg("g", attributes, polygon(body, { stroke: "var(--page)", "stroke-width": 0.15 }),
    polygon(window, { fill: "var(--page)", "fill-opacity": 0.75 }));
}

/** Lanes of segments, each with the line before which those wait who have no right of way. */
function lanes(scene) {
  const group = svg("g", { class: "lanes" });
  const line = (points, attributes) => svg("polyline", { points: points.map((point) => point.join(",")).join(" "),
    fill: "none", "stroke-linejoin": "round", ...attributes });
  for (const [more, stroke] of [[0.3, "var(--marking)"], [-0.1, "var(--asphalt)"]]) {
    group.append(...scene.roads.map((road) => line(road.line, { stroke, "stroke-width": road.width + more })));
  }
  group.append(...scene.roads.map((road) => line(road.giveWay, { stroke: "var(--marking)", "stroke-width": 0.35,
    "stroke-dasharray": "0.5 0.4" })));
  return group;
}

/** Roads that cross at the centre, two lanes each. */
function roads(scene) {
  const [c, w, far] = [scene.centre, scene.laneWidth, 500];
  const group = svg("g", {});
  for (const quarter of [0, 90, 180, 270]) {
    const arm = svg("g", { transform: `translate(${c} ${c}) rotate(${quarter})` });
    arm.append(
      svg("rect", { x: -w, y: 0, width: 2 * w, height: far, fill: "var(--asphalt)" }),
      svg("line", { x1: 0, y1: w + 0.75, x2: 0, y2: far, stroke: "var(--marking)", "stroke-width": 0.14,
        "stroke-dasharray": "1.5 1.5" }),
      ...[-w + 0.07, w - 0.07].map((x) =>
        svg("line", { x1: x, y1: w, x2: x, y2: far, stroke: "var(--marking)", "stroke-width": 0.14 })),
    );
    group.append(arm);
  }
  group.append(svg("rect", { x: c - w, y: c - w, width: 2 * w, height: 2 * w, fill: "var(--asphalt)" }));
  return group;
}

/** A line every five metres. */
function grid(scene) {
  const [left, low, size] = scene.box;
  const group = svg("g", { stroke: "var(--grid)", "stroke-width": 0.08 });
  for (let k = 5 * Math.ceil(left / 5); k <= left + size; k += 5) {
    group.append(svg("line", { x1: k, y1: low, x2: k, y2: low + size }));
  }
  for (let k = 5 * Math.ceil(low / 5); k <= low + size; k += 5) {
    group.append(svg("line", { x1: left, y1: k, x2: left + size, y2: k }));
  }
  return group;
}

/** The map of a scenario with the vehicles of some drives on it. */
class DriveMap {
  constructor(element) {
    this.element = element;
    this.title = element.querySelector("title");
  }

  /** Draw a scenario; `drives` are { label, drive }, the chosen one first. */
  show(scene, drives) {
    const [left, low, size] = scene.box;
    const world = svg("g", { transform: "scale(1 -1)" }); // y points up
    this.element.setAttribute("viewBox", `${left} ${-low - size} ${size} ${size}`);
    const paved = scene.lanes || scene.roads.length > 0;
    this.element.style.background = paved ? "var(--grass)" : "";
    world.append(scene.roads.length ? lanes(scene) : scene.lanes ? roads(scene) : grid(scene));
    this.routes(scene, world, paved ? "var(--marking)" : "var(--ink)");
    for (const [start, end] of scene.obstacles) {
      world.append(svg("line", { x1: start[0], y1: start[1], x2: end[0], y2: end[1], stroke: "var(--obstacle)",
        "stroke-width": 0.5, "stroke-linecap": "round", class: "obstacle" }));
    }
    const many = drives[0].drive.vehicles.length > 1;
    this.tracks = drives.flatMap(({ drive, label }, place) => drive.vehicles.map((track, v) => {
      const points = track.x.map((x, step) => `${x},${track.y[step]}`).join(" ");
      const line = { points, fill: "none", "stroke-linejoin": "round" };
      const path = svg("g", {}, svg("polyline", { ...line, stroke: "var(--page)", "stroke-width": 0.45 }),
        svg("polyline", { ...line, stroke: series(place), "stroke-width": 0.2,
          "stroke-dasharray": DASHES[place].map((part) => part / 8).join(" ") }));
      const vehicle = car(scene.vehicle, { class: "vehicle", fill: series(place), "data-policy": label,
        "data-vehicle": v });
      const number = svg("text", { class: "number" }, many ? String(v) : "");
      return { track, path, vehicle, number, shown: svg("g", {}, vehicle, number), leaves: many };
    }));
    // The cars around the chosen policy: they react to it, so those of other policies are elsewhere.
    this.decisions = drives[0].drive.decisions;
    this.cars = drives[0].drive.cars.map((track) => ({
      track,
      car: car(scene.vehicle, { class: "oncoming", fill: "var(--dim)" }),
    }));
    world.append(...this.tracks.map((track) => track.path), ...this.cars.map((each) => each.car));
    world.append(...this.tracks.map(({ shown }) => shown).reverse());
    this.element.replaceChildren(this.title, world);
    const ends = (drive) => drive.vehicles.map(({ end }) => end.replaceAll("_", " ")).join(", ");
    const names = drives.map(({ label, drive }) => `policy ${label} (${ends(drive)})`);
    this.title.textContent = `Map seen from above with the drives of ${names.join(", ")}`;
  }

  routes(scene, world, stroke) {
    for (const route of scene.routes) {
      route.forEach(([cx, cy], k) => {
        const last = k === route.length - 1;
        for (const r of last ? [scene.arrivalRadius, 1.8 * scene.arrivalRadius] : [scene.arrivalRadius]) {
          world.append(svg("circle", { cx, cy, r, fill: "none", stroke, "stroke-width": 0.15, "stroke-opacity": 0.75 }));
        }
      });
    }
  }

  /** Put every vehicle where it was after `step` decisions; one that has ended leaves the others, or stays alone. */
  move(step) {
    const place = (element, track, now) => {
      const at = `translate(${track.x[now].toFixed(2)} ${track.y[now].toFixed(2)})`;
      element.setAttribute("transform", `${at} rotate(${((track.heading[now] * 180) / Math.PI).toFixed(2)})`);
      return at;
    };
    for (const { track, vehicle, number, shown, leaves } of this.tracks) {
      const ended = step > track.decisions;
      number.setAttribute("transform", `${place(vehicle, track, Math.min(step, track.decisions))} scale(1 -1)`);
      vehicle.setAttribute("fill-opacity", ended ? 0.45 : 1);
      shown.style.display = ended && leaves ? "none" : "";
    }
    const now = Math.min(step, this.decisions);
    for (const { track, car: element } of this.cars) {
      const present = Number.isFinite(track.x[now]);
      element.style.display = present ? "" : "none";
      if (present) place(element, track, now);
    }
  }
}

/** Calls `tick` with every step from the present one to the last, at `frequency` steps per second. */
class Player {
  constructor(tick) {
    this.tick = tick;
    this.speed = 1;
    this.request = 0;
  }

  get playing() {
    return this.request !== 0;
  }

  play(step, last, frequency) {
    this.stop();
    let [from, position] = [performance.now(), step >= last ? 0 : step];
    const frame = (now) => {
      position = Math.min(position + (Math.max(now - from, 0) / 1000) * frequency * this.speed, last);
      from = now;
      this.request = position < last ? requestAnimationFrame(frame) : 0;
      this.tick(Math.floor(position));
    };
    this.request = requestAnimationFrame(frame);
  }

  stop() {
    cancelAnimationFrame(this.request);
    this.request = 0;
  }
}
