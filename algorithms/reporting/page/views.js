// The plots, drawn by Vega. Specifications hold no data: rows are put in by name, so that nothing of them is run.

function makeView(spec, element, label) {
  element.replaceChildren();
  const view = new vega.View(vega.parse(spec), { renderer: "svg", logLevel: vega.Error });
  view.description(label).initialize(element).run();
  return view;
}

/** Whether there is room for upright axes next to each other. */
const isUpright = (axes, width) => width >= 96 * axes.length;

/**
 * Parallel coordinates of returns that are scaled to [0, 1]. Axes are upright if there is room, else on top of each
 * other. Signals: `chosen` (indices, the chosen policy first), `listed` and `kept` (booleans), `brushing` (axis, from,
 * to), `picked`.
 */
function parallelSpec(axes, width) {
  const upright = isUpright(axes, width);
  // Beside more sliders there is more room.
  const height = upright ? 400 + 80 * Math.max(0, axes.length - 4) : 62 * axes.length + 10;
  const padding = upright ? { left: 46, right: 46, top: 46, bottom: 24 } : { left: 12, right: 12, top: 30, bottom: 24 };
  const [across, along] = upright ? ["x", "y"] : ["y", "x"];
  const inner = [width - padding.left - padding.right, height - padding.top - padding.bottom];
  const at = (shift = 0) => ({ scale: "axis", field: "axis", offset: shift });
  const spot = (position, value) => ({ [across]: position, [along]: value });
  const value = (field) => ({ scale: "value", field });
  const line = (encoding) => ({
    type: "line",
    from: { data: "line" },
    interactive: true,
    encode: { update: { ...spot({ scale: "axis", field: "axis" }, value("value")), ...encoding } },
  });
  const lines = (data, encoding, name) => ({
    type: "group",
    aria: false,
    from: { facet: { name: "line", data, groupby: "policy" } },
    marks: [{ ...line(encoding), ...(name ? { name } : {}) }],
  });
  // Twice, the first time as its own background.
  const text = (encoding) => [{ stroke: { value: "var(--panel)" }, strokeWidth: { value: 4 } }, {}].map((outline) => ({
    type: "text", from: { data: "axes" }, aria: false, interactive: false,
    encode: { update: { font: { value: FONT }, ...encoding, ...outline } } }));
  const role = "indexof(chosen, datum.policy)";
  const [near, far] = upright
    ? [{ y: { signal: "height + 14" }, x: at(), align: { value: "center" } },
       { y: { value: -10 }, x: at(), align: { value: "center" } }]
    : [{ x: { value: 0 }, y: at(17), align: { value: "left" } },
       { x: { signal: "width" }, y: at(17), align: { value: "right" } }];
  const title = upright ? { y: { value: -28 }, x: at(), align: { value: "center" } }
    : { x: { value: 0 }, y: at(-11), align: { value: "left" } };
  return {
    $schema: "https://vega.github.io/schema/vega/v6.json",
    autosize: "none",
    width: inner[0],
    height: inner[1],
    padding,
    signals: [
      { name: "chosen", value: [] },
      { name: "listed", value: [] },
      { name: "kept", value: [] },
      { name: "hovered", value: null, on: [
        { events: "@learntLine:pointerover", update: "datum.policy" },
        { events: "@learntLine:pointerout", update: "null" }] },
      { name: "picked", value: null, on: [{ events: "@learntLine:click", update: "{policy: datum.policy}" }] },
      { name: "brushing", value: null, on: [
        { events: "@hit:pointerdown", update: `{axis: datum.axis, from: clamp(invert('value', ${along}()), 0, 1), `
          + `to: clamp(invert('value', ${along}()), 0, 1)}` },
        { events: "[@hit:pointerdown, window:pointerup] > window:pointermove!",
          update: `{axis: brushing.axis, from: brushing.from, to: clamp(invert('value', ${along}()), 0, 1)}` }] },
    ],
    data: [
      { name: "axes" }, { name: "bestKnown" }, { name: "learnt" }, { name: "brushes" },
      { name: "visible", source: "learnt", transform: [{ type: "filter", expr: "listed[datum.policy]" }] },
      { name: "shown", source: "learnt", transform: [{ type: "filter", expr: `${role} >= 0` }] },
    ],
    scales: [
      { name: "axis", type: "point", range: upright ? "width" : "height", domain: axes.map(({ axis }) => axis) },
      { name: "value", range: upright ? "height" : "width", domain: [0, 1], zero: false },
    ],
    marks: [
      lines("bestKnown", { stroke: { value: "var(--front)" }, strokeOpacity: { value: 0.5 }, strokeWidth: { value: 1 },
        strokeDash: { value: [1, 3] } }),
      { type: "rule", from: { data: "axes" }, aria: false, interactive: false, encode: { update: {
        ...spot(at(), { value: 0 }), [`${along}2`]: { signal: upright ? "height" : "width" },
        stroke: { value: "var(--dim)" } } } },
      lines("visible", {
        stroke: { value: "var(--front)" },
        strokeOpacity: { signal: "datum.policy === hovered ? 1 : kept[datum.policy] ? 0.6 : 0.1" },
        strokeWidth: { signal: "datum.policy === hovered ? 3 : 1.3" }, cursor: { value: "pointer" } }, "learntLine"),
      { type: "rect", name: "brush", from: { data: "brushes" }, aria: false, interactive: false, encode: { update: {
        ...spot(at(-8), value("low")), [`${across}2`]: at(8), [`${along}2`]: value("high"),
        fill: { value: "var(--ink)" }, fillOpacity: { value: 0.2 }, stroke: { value: "var(--ink)" } } } },
      lines("shown", {
        stroke: { signal: `'var(--series-' + max(${role}, 0) + ')'` }, strokeWidth: { value: 3.5 },
        strokeDash: { signal: `${JSON.stringify(DASHES)}[max(${role}, 0)]` } }, "shownLine"),
      { type: "rect", name: "hit", from: { data: "axes" }, aria: false, encode: { update: {
        ...spot(at(-14), { value: -6 }), [`${across}2`]: at(14),
        [`${along}2`]: { signal: upright ? "height + 6" : "width + 6" },
        fill: { value: "transparent" }, cursor: { value: "crosshair" } } } },
      ...text({ ...title, text: { field: "title" }, fontSize: { value: 13 }, fill: { value: "var(--ink)" } }),
      ...text({ ...near, text: { field: "worst" }, fontSize: { value: 11 }, fill: { value: "var(--dim)" },
        baseline: { value: "middle" } }),
      ...text({ ...far, text: { field: "best" }, fontSize: { value: 11 }, fill: { value: "var(--dim)" },
        baseline: { value: "middle" } }),
    ],
  };
}

/** Readings over time, one line per policy shown, with a rule at the signal `now` (s). */
function timeSpec(title, width) {
  return {
    $schema: "https://vega.github.io/schema/vega/v6.json",
    autosize: { type: "fit", contains: "padding", resize: true },
    width,
    height: width >= 480 ? 210 : 150,
    padding: 4,
    title: { text: title, anchor: "start", font: FONT, fontSize: 13, fontWeight: "normal", color: "var(--ink)" },
    signals: [{ name: "now", value: 0 }],
    data: [{ name: "readings" }],
    scales: [
      { name: "x", domain: { data: "readings", field: "time" }, range: "width", zero: true },
      { name: "y", domain: { data: "readings", field: "value" }, range: "height", zero: true, nice: true },
    ],
    axes: ["x", "y"].map((scale) => ({
      scale, orient: scale === "x" ? "bottom" : "left", tickCount: scale === "x" ? 6 : 4, grid: scale === "y",
      gridColor: "var(--line)", domainColor: "var(--faint)", tickColor: "var(--faint)", labelColor: "var(--dim)",
      titleColor: "var(--dim)", labelFont: FONT, titleFont: FONT, labelFontSize: 11, titleFontWeight: "normal",
      ...(scale === "x" ? { title: "time (s)" } : { minExtent: 34 }),
    })),
    marks: [
      { type: "group", aria: false, from: { facet: { name: "drive", data: "readings", groupby: "place" } }, marks: [
        { type: "line", from: { data: "drive" }, encode: { update: {
          x: { scale: "x", field: "time" }, y: { scale: "y", field: "value" }, strokeWidth: { value: 2 },
          stroke: { signal: "'var(--series-' + datum.place + ')'" },
          strokeDash: { signal: `${JSON.stringify(DASHES)}[datum.place]` } } } }] },
      { type: "rule", aria: false, encode: { update: {
        x: { scale: "x", signal: "now" }, y: { value: 0 }, y2: { signal: "height" },
        stroke: { value: "var(--ink)" } } } },
    ],
  };
}
