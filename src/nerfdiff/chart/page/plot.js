// The chart: points with their intervals, the frontier as a step line, published values.
const LETTER = 7.5, MARK = 48; // pixels in the legend

// Around the plot: room for the labels of published values on the right, and above for the lines of the legend.
function marginFor(traces, published) {
  const margin = { l: 62, r: !published.length ? 16 : WIDE() ? 150 : 104, b: 56 };
  const names = traces.filter((trace) => trace.showlegend !== false).map((trace) => MARK + LETTER * trace.name.length);
  const wide = names.reduce((a, b) => a + b, 0) / ($("plot").clientWidth - margin.l - margin.r);
  return { ...margin, t: 16 + 22 * Math.ceil(1.1 * wide) };
}

function shownPublished() {
  if (!$("published").checked) return [];
  return panel().published.filter((entry) => entry.metrics[state.metric] !== undefined);
}

// Whether published values leave our points room; switched on and off by hand, they stay so.
function roomForPublished() {
  const own = points().map((number) => mean(number, state.metric)), costs = points().map((number) => mean(number, state.cost));
  const published = panel().published.filter((entry) => entry.metrics[state.metric] !== undefined);
  const span = (found) => found.reduce((a, b) => Math.max(a, b), -Infinity) - found.reduce((a, b) => Math.min(a, b), Infinity);
  const logs = (found) => found.filter((cost) => cost > 0).map(Math.log10);
  const room = (ours, theirs) => span(ours) >= 0.2 * span([...ours, ...theirs]);
  const timed = published.map((entry) => entry.costs[state.cost]).filter((cost) => cost !== undefined);
  const fits = room(own, published.map((entry) => entry.metrics[state.metric])) && room(logs(costs), logs(timed));
  return WIDE() && (fits || published.some((entry) => entry.same_size));
}

function draw() {
  if (!state.switched) $("published").checked = roomForPublished();
  const numbers = points(), published = shownPublished(), best = new Set(frontierOf(state.metric, state.cost));
  if (!numbers.length) return drawNothing();
  const timed = published.filter((entry) => entry.costs[state.cost] !== undefined);
  const untimed = published.filter((entry) => entry.costs[state.cost] === undefined);
  const costs = [...numbers.map((number) => mean(number, state.cost)), ...timed.map((entry) => entry.costs[state.cost])];
  const bounds = (field) => (intervals() ? numbers.flatMap((number) => value(number, field)) : []);
  const x = costAxis(costs, bounds(state.cost), untimed.length ? 0.08 : 0);
  const ends = [...numbers.map((number) => mean(number, state.metric)), ...bounds(state.metric)];
  const yaxis = metricAxis([...ends, ...published.map((entry) => entry.metrics[state.metric])]);
  const traces = [];
  const { numeric, groups } = colouring(numbers);
  const colours = new Map(groups.flatMap(({ words, colour }) => words.map((word) => [word, colour])));
  for (const { colour, legend } of groups) if (legend !== null) traces.push(legendEntry(colour, legend));
  // a trace per kind, which its legend hides; one of all numbers, which may be thousands
  for (const [name, words] of numeric ? [["all", [...colours.keys()]]] : groups.map(({ legend, words }) => [legend, words])) {
    const own = new Set(words), group = numbers.filter((number) => own.has(colourValue(number)));
    traces.push(pointTrace(group.filter((number) => !best.has(number)), name, colours, x, true));
    traces.push(pointTrace(group.filter((number) => best.has(number)), name, colours, x, false));
  }
  traces.push(frontierTrace([...best], x), ring(x), ...publishedTraces(timed, untimed, x));
  const margin = marginFor(traces, published), { clientWidth, clientHeight } = $("plot");
  const size = [clientWidth - margin.l - margin.r, clientHeight - margin.t - margin.b];
  const layout = {
    xaxis: x.axis, yaxis, margin, hovermode: "closest", dragmode: WIDE() ? "zoom" : false, showlegend: true,
    legend: {
      orientation: "h", y: 1.02, yanchor: "bottom", x: 0, uirevision: `${state.panel} ${state.colour}`,
      itemclick: numeric ? false : "toggle", itemdoubleclick: numeric ? false : "toggleothers",
    },
    paper_bgcolor: "#fff", plot_bgcolor: "#fff",
    font: { family: "system-ui, sans-serif", size: WIDE() ? 13 : 11, color: "#1d2430" },
    shapes: untimed.length ? [band(x)] : [],
    annotations: publishedLabels(timed, untimed, x, yaxis.range, size), uirevision: `${state.panel} ${state.metric} ${state.cost}`,
  };
  const modeBarButtonsToRemove = ["select2d", "lasso2d", "autoScale2d"];
  const config = { responsive: true, displaylogo: false, modeBarButtonsToRemove, displayModeBar: WIDE() ? "hover" : false };
  Plotly.react($("plot"), traces.filter((trace) => trace.x.length || trace.name === "chosen"), layout, config);
  $("plot-note").textContent = noteOn(numbers, published);
}

function noteOn(numbers, published) {
  const all = panel().members.length, missing = all - numbers.length, notes = [];
  const what = `${costOf(state.cost).name} or ${metricOf(state.metric).name}`;
  if (many()) notes.push(`Intervals of more than ${data.webgl_above} points are in the table only.`);
  const memory = costOf(state.cost).on_cpu;
  if (memory && panel().cpu) notes.push(`${costOf(state.cost).name}: ${memory}.`);
  if (missing) notes.push(`${missing} of ${all} configurations have no ${what}: they are in the table only.`);
  const sizes = [...new Set(published.map((entry) => `${entry.image_size} pixels`))].join(", ");
  if (published.some((entry) => !entry.same_size))
    notes.push(`Published values (◇) are of ${sizes}, other test images and other devices: for the order of things only.`);
  else if (published.length) notes.push("Published values (◇) are from other devices.");
  return notes.join(" ");
}

function drawNothing() {
  Plotly.purge($("plot"));
  delete $("plot").dataset.listening;
  const what = `${metricOf(state.metric).name} and ${costOf(state.cost).name}`;
  $("plot").replaceChildren(element("p", { className: "notice" }, `No configuration here has both ${what}; choose another cost.`));
  $("plot-note").textContent = "";
}

function bars(numbers, field, colour, at = (number) => number) {
  const found = numbers.map((number) => value(number, field));
  const above = found.map((values) => (values.length > 1 ? values[2] - values[0] : 0));
  // a bar down to zero has no end on a logarithmic axis: it ends at a hundredth
  const below = found.map((values) => (values.length > 1 ? values[0] - at(values[1]) : 0));
  return { type: "data", symmetric: false, array: above, arrayminus: below, color: colour, thickness: 1.2, width: 3, visible: intervals() };
}

// Plotly takes the text of a legend for markup.
const legendText = (name) => (name.length > 60 ? `${name.slice(0, 59)}…` : name).replaceAll("&", "&amp;").replaceAll("<", "&lt;");

// Of its own, so that it is neither faint nor a ring.
function legendEntry(colour, name) {
  const marker = { color: colour, size: 10 }, uid = uidOf("legend", name);
  return { type: "scatter", mode: "markers", name: legendText(name), uid, legendgroup: name, x: [null], y: [null], marker, hoverinfo: "skip", meta: "legend" };
}

// What is hidden stays so by its uid, and no other group takes its place. Plotly wants one that can stand in a selector.
const uidOf = (...parts) => [...[state.panel, state.colour, ...parts].join(" ")].map((letter) => letter.codePointAt(0)).join("-");
const many = () => points().length > data.webgl_above;
const intervals = () => $("intervals").checked && !many();

function pointTrace(numbers, name, colours, x, dominated) {
  const own = numbers.map((number) => colours.get(colourValue(number)));
  const one = new Set(own).size === 1 ? own[0] : "#5c6675"; // bars of a trace have one colour
  const meta = dominated ? "dominated" : "frontier", bar = dominated ? faint(one, 0.22) : one;
  const symbol = numbers.map((number) => (data.configurations[number].failed ? "circle-open" : "circle"));
  const gl = many() && webgl;
  return {
    type: gl ? "scattergl" : "scatter", mode: "markers", name, uid: uidOf(meta, name), legendgroup: name, showlegend: false,
    x: numbers.map((number) => x.at(mean(number, state.cost))), y: numbers.map((number) => mean(number, state.metric)),
    customdata: numbers, hoverinfo: "none", meta,
    marker: { color: dominated ? own.map((colour) => faint(colour, 0.3)) : own, size: dominated ? 8 : 11, symbol, line: { width: dominated ? 0 : 1.2, color: "#fff" } },
    error_y: bars(numbers, state.metric, bar), error_x: bars(numbers, state.cost, bar, (low) => Math.max(low, 1e-12)),
  };
}

function frontierTrace(numbers, x) {
  const at = numbers.map((number) => [x.at(mean(number, state.cost)), mean(number, state.metric)]);
  if (at.length) at.push([x.edge, at.at(-1)[1]]);
  return {
    type: "scatter", mode: "lines", name: "frontier", uid: "step", showlegend: true, x: at.map(([cost]) => cost), y: at.map(([, quality]) => quality),
    line: { shape: "hv", color: "#1d2430", width: 1.6 }, hoverinfo: "skip", meta: "step",
  };
}

function ring(x) {
  const there = state.chosen !== null && both(state.chosen) && panel().members.includes(state.chosen);
  return {
    type: "scatter", mode: "markers", name: "chosen", uid: "chosen", showlegend: false, hoverinfo: "skip", meta: "chosen",
    x: there ? [x.at(mean(state.chosen, state.cost))] : [], y: there ? [mean(state.chosen, state.metric)] : [],
    marker: { size: 19, color: "rgba(0,0,0,0)", line: { width: 2.5, color: "#1d2430" } },
  };
}

function publishedTraces(timed, untimed, x) {
  const trace = (entries, place, meta, legend) => ({
    type: "scatter", mode: "markers", name: "published", uid: uidOf(meta), legendgroup: "published", showlegend: legend && entries.length > 0, meta,
    x: entries.map(place), y: entries.map((entry) => entry.metrics[state.metric]), customdata: entries.map((entry) => ({ published: entry })),
    hoverinfo: "none", cliponaxis: false, marker: { symbol: "diamond-open", size: 10, color: "#6b4a00", line: { width: 1.6 } },
  });
  const column = () => 10 ** (x.range[1] - ((1 - x.share) / 2) * (x.range[1] - x.range[0]));
  return [trace(timed, (entry) => x.at(entry.costs[state.cost]), "published", true), trace(untimed, column, "published without a cost", !timed.length)];
}

// Behind what has no place on the axis.
function band(x) {
  const box = { xref: "paper", yref: "paper", x0: x.share, x1: 1, y0: 0, y1: 1 };
  return { ...box, type: "rect", line: { width: 0 }, fillcolor: "#faf4e6", layer: "below" };
}

function publishedLabels(timed, untimed, x, range, size) {
  const letters = WIDE() ? 11 : 9;
  const style = { showarrow: true, arrowhead: 0, arrowwidth: 0.8, arrowcolor: "#b9a06a", font: { size: letters, color: "#6b4a00" }, yref: "y", standoff: 6 };
  const shifts = spreadLabels(untimed.map((entry) => entry.metrics[state.metric]), range, size[1], letters + 3);
  const right = untimed.map((entry, at) => ({
    ...style, text: entry.method, xref: "paper", x: 0.5 + x.share / 2, y: entry.metrics[state.metric], ax: WIDE() ? 26 : 14, ay: shifts[at], xanchor: "left",
  }));
  const places = timed.map((entry) => [Math.log10(x.at(entry.costs[state.cost])), entry.metrics[state.metric], entry.method.length]);
  const lines = freeLines(places, x.range, range, size, letters);
  const near = timed.map((entry, at) => ({ ...style, text: entry.method, x: places[at][0], y: places[at][1], ax: 0, ay: lines[at] }));
  const foot = { xref: "paper", yref: "paper", x: x.share, y: 0, xanchor: "left", yanchor: "bottom" };
  const told = { ...foot, text: "cost not published", showarrow: false, textangle: -90, font: style.font };
  return [...right, ...near, ...(untimed.length ? [told] : [])];
}

const webgl = (() => {
  const context = document.createElement("canvas").getContext("webgl");
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  return context !== null;
})();
