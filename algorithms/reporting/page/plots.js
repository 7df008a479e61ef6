// The explorer's plots.

/** A text on the map's ground. */
const note = (x, y, text, size, colour, anchor = "middle") => svg("text", { x, y, "font-size": size, fill: colour, stroke: "var(--panel)",
  "stroke-width": 4, "paint-order": "stroke", "text-anchor": anchor, "dominant-baseline": "middle", "pointer-events": "none" }, text);

/** Parallel coordinates of shares, 0 the worst and 1 the best; `pick(policy)` and `brush(axis, from, to)` are told of clicks and drags. */
class Parallel {
  constructor(host, pick, brush) { Object.assign(this, { host, pick, brush }); }
  /** `axes` are { title, worst, best }; the rows of shares end early where a policy has no value. */
  draw(axes, learnt, bestKnown) {
    const width = this.host.clientWidth;
    this.upright = width >= 96 * axes.length;
    const height = this.upright ? 470 + 80 * Math.max(0, axes.length - 4) : 62 * axes.length + 64;
    const [left, top] = this.upright ? [46, 46] : [12, 30];
    const [across, along] = this.upright ? [width - 92, height - 70] : [height - 54, width - 24];
    const axis = (i) => (axes.length > 1 ? (i * across) / (axes.length - 1) : across / 2);
    this.at = (i, share) => (this.upright ? [left + axis(i), top + (1 - share) * along] : [left + share * along, top + axis(i)]);
    this.share = ({ x, y }) => Math.min(Math.max(this.upright ? (top + along - y) / along : (x - left) / along, 0), 1);
    this.box = (i, from, to, beside, beyond) => {
      const ends = [this.at(i, from), this.at(i, to)];
      const [x, y] = [0, 1].map((k) => Math.min(ends[0][k], ends[1][k]) - ((k === 0) === this.upright ? beside : beyond));
      const [long, wide] = [Math.abs(to - from) * along + 2 * beyond, 2 * beside];
      return { x, y, width: this.upright ? wide : long, height: this.upright ? long : wide };
    };
    this.learnt = learnt;
    [this.under, this.over] = [svg("g"), svg("g", { "pointer-events": "none" })];
    const texts = axes.flatMap(({ title, worst, best }, i) => {
      const [[x, y], [endX, endY]] = [this.at(i, 0), this.at(i, 1)];
      return this.upright
        ? [note(x, top - 28, title, 13, "var(--ink)"), note(x, y + 14, worst, 11, "var(--dim)"), note(x, endY - 10, best, 11, "var(--dim)")]
        : [note(x, y - 14, title, 13, "var(--ink)", "start"), note(x, y + 15, worst, 11, "var(--dim)", "start"),
          note(endX, y + 15, best, 11, "var(--dim)", "end")];
    });
    this.svg = svg("svg", { width, height, role: "img",
      "aria-label": `Parallel coordinates of ${learnt.length} policies; the table of all policies has their numbers` },
    ...bestKnown.map((row) => this.line(row, { stroke: "var(--front)", "stroke-opacity": 0.5, "stroke-dasharray": "1 3" })),
    ...axes.map((_, i) => polyline([this.at(i, 0), this.at(i, 1)], { stroke: "var(--dim)" })), this.under, this.over,
    ...axes.map((_, i) => this.handle(i)), ...texts);
    this.host.dataset.upright = this.upright;
    this.host.replaceChildren(this.svg);
  }

  line(row, attributes) { return polyline(row.map((share, i) => this.at(i, share)), { class: "line", ...attributes }); }

  handle(i) {
    let from = null;
    const share = (event) => {
      const box = this.svg.getBoundingClientRect();
      return this.share({ x: event.clientX - box.x, y: event.clientY - box.y });
    };
    const hit = svg("rect", { class: "hit", fill: "transparent", ...this.box(i, 0, 1, 14, 6), onpointerdown: (event) => {
        hit.setPointerCapture(event.pointerId);
        from = share(event);
        this.brush(i, from, from);
      }, onpointermove: (event) => from !== null && this.brush(i, from, share(event)),
      onpointerup: () => (from = null), onpointercancel: () => (from = null) });
    return hit;
  }
  /** Which policies are `listed`, and of these `kept`; those that are `shown` in their colours; the ranges as shares. */
  show({ listed, kept, shown, ranges }) {
    this.under.replaceChildren(...this.learnt.flatMap((row, k) => (listed[k] ? [this.line(row, { class: "line policy",
      stroke: "var(--front)", "stroke-opacity": kept[k] ? 0.6 : 0.1, onclick: () => this.pick(k) })] : [])));
    this.over.replaceChildren(
      ...ranges.map(({ axis, low, high }) => svg("rect", { class: "brush", ...this.box(axis, low, high, 8, 0) })),
      ...shown.map((k, place) => this.line(this.learnt[k], { stroke: series(place), "stroke-width": 3.5,
        "stroke-dasharray": DASHES[place].join(" ") })));
  }
}

/** Marks from 0 to about `most`, some four of them. */
function marks(most, count) {
  const rough = Math.max(most, 1e-9) / count;
  const unit = 10 ** Math.floor(Math.log10(rough));
  const step = unit * [1, 2, 5, 10].find((each) => each * unit >= rough);
  return times(Math.ceil(most / step - 1e-9) + 1, (k) => Number((k * step).toPrecision(6)));
}

/** Readings over time, a line (values, one per decision) for each policy shown; returns what moves the rule of the present. */
function drawTimes(host, title, lines, frequency, names) {
  const [width, height] = [host.clientWidth, host.clientWidth >= 480 ? 210 : 150];
  const [left, right, top, bottom] = [44, width - 8, 26, height - 38];
  const longest = (Math.max(...lines.map((values) => values.length)) - 1) / frequency;
  const up = marks(Math.max(...lines.flat(), 1e-3), 4);
  const x = (time) => left + (time / (longest || 1)) * (right - left);
  const y = (value) => bottom - (value / up.at(-1)) * (bottom - top);
  const rule = polyline([], { stroke: "var(--ink)" });
  host.replaceChildren(svg("svg", { width, height, role: "img", "aria-label": `${title} over time of ${names}` },
    note(left, 10, title, 13, "var(--ink)", "start"), note((left + right) / 2, height - 8, "time (s)", 11, "var(--dim)"),
    ...up.flatMap((value) => [polyline([[left, y(value)], [right, y(value)]], { stroke: "var(--line)" }),
      note(left - 6, y(value), String(value), 11, "var(--dim)", "end")]),
    ...marks(longest, 6).filter((time) => time <= longest).map((time) => note(x(time), bottom + 13, String(time), 11, "var(--dim)")),
    ...lines.map((values, place) => polyline(values.map((value, k) => [x(k / frequency).toFixed(1), y(value).toFixed(1)]), {
      stroke: series(place), "stroke-width": 2, "stroke-dasharray": DASHES[place].join(" ") })), rule));
  return (time) => rule.setAttribute("points", joined([[x(time), top], [x(time), bottom]]));
}
