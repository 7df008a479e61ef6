// The map with drives on it, as the simulator recorded them, or as it makes them now.

/** A stored drive with its readings as numbers: each is the sum of the stored differences up to it. */
function decodeDrive(stored, resolution) {
  const decoded = ({ end, ...readings }) => {
    const sums = Object.entries(readings).map(([name, differences]) => {
      let total = 0;
      return [name, differences.map((step) => (step === null ? null : (total += step) * resolution[name]))];
    });
    return { end, decisions: readings.x.length - 1, ...Object.fromEntries(sums) };
  };
  const [vehicles, cars] = [stored.vehicles.map(decoded), stored.cars.map(decoded)];
  return { vehicles, cars, decisions: Math.max(...vehicles.map((vehicle) => vehicle.decisions)) };
}

const joined = (points) => points.map((point) => point.join(",")).join(" ");
const polyline = (points, attributes = {}) =>
  svg("polyline", { points: joined(points), fill: "none", "stroke-linejoin": "round", ...attributes });

/** A car that faces up, with its centre at the origin. */
function car(size, attributes) {
  const [y, x] = size.map((each) => each / 2);
  const body = [[-x, -y + 0.3], [-x + 0.25, -y], [x - 0.25, -y], [x, -y + 0.3], [x, y - 0.7], [x - 0.4, y],
    [-x + 0.4, y], [-x, y - 0.7]];
  const window = [[-x + 0.3, 0.1 * y], [x - 0.3, 0.1 * y], [x - 0.55, 0.42 * y], [-x + 0.55, 0.42 * y]];
  return svg("g", attributes, svg("polygon", { points: joined(body), stroke: "var(--page)", "stroke-width": 0.15 }),
    svg("polygon", { points: joined(window), fill: "var(--page)", "fill-opacity": 0.75 }));
}

/** Lanes of segments, each with the line before which those wait who have no right of way. */
function lanes({ roads: all }) {
  const paved = [[0.3, "var(--marking)"], [-0.1, "var(--asphalt)"]].flatMap(([more, stroke]) =>
    all.map((road) => polyline(road.line, { stroke, "stroke-width": road.width + more })));
  return svg("g", { class: "lanes" }, ...paved, ...all.map((road) =>
    polyline(road.giveWay, { stroke: "var(--marking)", "stroke-width": 0.35, "stroke-dasharray": "0.5 0.4" })));
}

/** Roads that cross at the centre, two lanes each. */
function roads({ centre: c, laneWidth: w }) {
  const far = 500;
  const line = (x, from, dashes) => svg("line", { x1: x, y1: from, x2: x, y2: far, stroke: "var(--marking)",
    "stroke-width": 0.14, "stroke-dasharray": dashes });
  return svg("g", {}, ...[0, 90, 180, 270].map((quarter) => svg("g", { transform: `translate(${c} ${c}) rotate(${quarter})` },
    svg("rect", { x: -w, y: 0, width: 2 * w, height: far, fill: "var(--asphalt)" }), line(0, w + 0.75, "1.5 1.5"),
    line(-w + 0.07, w, ""), line(w - 0.07, w, ""))),
  svg("rect", { x: c - w, y: c - w, width: 2 * w, height: 2 * w, fill: "var(--asphalt)" }));
}

/** A line every five metres. */
const grid = ({ box: [left, low, size] }) => svg("g", { stroke: "var(--grid)", "stroke-width": 0.08 },
  ...times(Math.ceil((3 * size) / 5), (k) => [left, low].map((from) => 5 * Math.ceil((from - size) / 5 + k))).flatMap(([x, y]) => [
    polyline([[x, low - size], [x, low + 2 * size]]), polyline([[left - size, y], [left + 2 * size, y]])]));

/** The map of a scenario with the vehicles of some drives on it. */
class DriveMap {
  constructor(element) { this.element = element; this.title = element.querySelector("title"); }
  /** Draw a scenario with drives { label, drive }, the chosen one first; `colours` by vehicle and `ghost` are optional. */
  show(scene, drives) {
    const [left, low, size] = scene.box;
    const world = svg("g", { transform: "scale(1 -1)" }); // y points up
    this.element.setAttribute("viewBox", `${left} ${-low - size} ${size} ${size}`);
    const paved = scene.lanes || scene.roads.length > 0;
    this.element.style.background = paved ? "var(--grass)" : "";
    world.append(scene.roads.length ? lanes(scene) : scene.lanes ? roads(scene) : grid(scene));
    this.routes(scene, world, paved ? "var(--marking)" : "var(--ink)");
    world.append(...scene.obstacles.map((ends) => polyline(ends, { stroke: "var(--obstacle)", "stroke-width": 0.5,
      "stroke-linecap": "round", class: "obstacle" })));
    const many = drives[0].drive.vehicles.length > 1;
    this.tracks = drives.flatMap(({ drive, label, colours, ghost }, place) => drive.vehicles.map((track, v) => {
      const fill = colours?.[v] ?? series(place);
      const dashes = DASHES[place].map((part) => part / 8).join(" ");
      const lines = [["var(--page)", 0.45, ""], [fill, 0.2, dashes]].map(([stroke, width, dash]) =>
        polyline([], { stroke, "stroke-width": width, "stroke-dasharray": dash }));
      const vehicle = car(scene.vehicle, { class: "vehicle", fill, opacity: ghost ? 0.55 : 1, "data-policy": label,
        "data-vehicle": v });
      const number = svg("text", { class: "number" }, many ? String(v) : "");
      return { track, lines, vehicle, number, shown: svg("g", {}, vehicle, number), leaves: many };
    }));
    // The cars around the chosen policy: they react to it, so those of other policies are elsewhere.
    this.main = drives[0].drive;
    this.cars = this.main.cars.map((track) => ({ track, car: car(scene.vehicle, { class: "oncoming", fill: "var(--dim)" }) }));
    world.append(...this.tracks.flatMap((track) => track.lines), ...this.cars.map((each) => each.car));
    world.append(...this.tracks.map(({ shown }) => shown).reverse());
    this.element.replaceChildren(this.title, world);
    this.extend();
    const ends = (drive) => drive.vehicles.map(({ end }) => plain(end) || "driving").join(", ");
    const names = drives.map(({ label, drive }) => `${/^\d/.test(label) ? "policy " : ""}${label} (${ends(drive)})`);
    this.title.textContent = `Map seen from above with the drives of ${names.join(", ")}`;
  }
  /** Give a vehicle of the first drive another colour. */
  paint(v, colour) { this.tracks[v].vehicle.setAttribute("fill", colour); this.tracks[v].lines[1].setAttribute("stroke", colour); }
  /** Draw the lines as far as the drives have come. */
  extend() {
    for (const { track, lines } of this.tracks) {
      const points = track.x.map((x, step) => `${x},${track.y[step]}`).join(" ");
      for (const line of lines) line.setAttribute("points", points);
    }
  }

  routes({ routes, arrivalRadius }, world, stroke) {
    const ring = ([cx, cy], r) => svg("circle", { cx, cy, r, fill: "none", stroke, "stroke-width": 0.15, "stroke-opacity": 0.75 });
    world.append(...routes.flatMap((route) => [...route.map((at) => ring(at, arrivalRadius)), ring(route.at(-1), 1.8 * arrivalRadius)]));
  }
  /** Put every vehicle where it was after `step` decisions; between two of them, between its poses. Of several, those leave that end. */
  move(step) {
    const place = (element, { x, y, heading }, at) => {
      const [now, share] = [Math.floor(at), at % 1];
      const between = (values) => (share ? values[now] + share * (values[now + 1] - values[now]) : values[now]);
      const to = `translate(${between(x).toFixed(2)} ${between(y).toFixed(2)})`;
      element.setAttribute("transform", `${to} rotate(${((between(heading) * 180) / Math.PI).toFixed(2)})`);
      return to;
    };
    for (const { track, vehicle, number, shown, leaves } of this.tracks) {
      const ended = step > track.decisions;
      number.setAttribute("transform", `${place(vehicle, track, Math.min(step, track.decisions))} scale(1 -1)`);
      vehicle.setAttribute("fill-opacity", ended ? 0.45 : 1);
      shown.style.display = ended && leaves ? "none" : "";
    }
    const now = Math.min(step, this.main.decisions);
    for (const { track, car: element } of this.cars) {
      const [before, after] = [Math.floor(now), Math.ceil(now)].map((each) => Number.isFinite(track.x[each]));
      element.style.display = before ? "" : "none";
      if (before) place(element, track, after ? now : Math.floor(now));
    }
  }
}

/** Calls `tick` with the present step up to the last one, at `frequency` steps per second; whole ones unless `smooth`. */
class Player {
  constructor(tick, smooth = false) { Object.assign(this, { tick, smooth, speed: 1, request: 0 }); }
  get playing() { return this.request !== 0; }

  play(step, last, frequency) {
    this.stop();
    let [from, position] = [performance.now(), step >= last ? 0 : step];
    const frame = (now) => {
      position = Math.min(position + (Math.max(now - from, 0) / 1000) * frequency * this.speed, last);
      from = now;
      this.request = position < last ? requestAnimationFrame(frame) : 0;
      try {
        this.tick(this.smooth ? position : Math.floor(position));
      } catch (error) {
        this.stop();
        showError(error);
      }
    };
    this.request = requestAnimationFrame(frame);
  }

  stop() { cancelAnimationFrame(this.request); this.request = 0; }
}
