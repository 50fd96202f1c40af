// The chart: points with the intervals of their differences, the frontier as a step line, published values.
let home = null; // the ranges of the axes before anyone zooms

function shownPublished() {
  if (!$("published").checked) return [];
  return panel().published.filter((entry) => entry.metrics[state.metric] !== undefined);
}

// The points whose colour the legend does not hide.
function shownPoints() {
  const numbers = points(), { numeric, groups } = colouring(numbers);
  const hidden = new Set(numeric ? [] : groups.filter(({ legend }) => isHidden(legend)).flatMap((group) => group.words));
  return numbers.filter((number) => !hidden.has(colourValue(number)));
}

function axisOf(numbers) {
  const published = shownPublished(), timed = published.filter((entry) => entry.costs[state.cost] !== undefined);
  const costs = [...numbers.map((number) => mean(number, state.cost)), ...timed.map((entry) => entry.costs[state.cost])];
  return costAxis(costs, published.length > timed.length ? 0.08 : 0);
}

function draw() {
  const numbers = points(), published = shownPublished(), best = new Set(frontierOf(state.metric, state.cost));
  drawLegend(numbers, colouring(numbers), published);
  if (!numbers.length) return drawNothing();
  const timed = published.filter((entry) => entry.costs[state.cost] !== undefined);
  const untimed = published.filter((entry) => entry.costs[state.cost] === undefined);
  const x = axisOf(numbers), kinds = colouring(numbers);
  const ends = numbers.flatMap((number) => [height(number), ...reach(number).map((end) => height(number) + end)]);
  const yaxis = metricAxis([...ends, ...published.map((entry) => entry.metrics[state.metric])]);
  const colours = new Map(kinds.groups.flatMap(({ words, colour }) => words.map((word) => [word, colour])));
  const shown = new Set(shownPoints()), traces = [];
  // a trace per kind, whose bars have one colour; one of all numbers, which may be thousands
  for (const words of kinds.numeric ? [[...colours.keys()]] : kinds.groups.map((group) => group.words)) {
    const own = new Set(words), group = numbers.filter((number) => shown.has(number) && own.has(colourValue(number)));
    traces.push(pointTrace(group.filter((number) => !best.has(number)), colours, x, true));
    traces.push(pointTrace(group.filter((number) => best.has(number)), colours, x, false));
  }
  const marked = (number) => number !== null && shown.has(number);
  traces.push(frontierTrace([...best], x), ring(state.chosen, marked(state.chosen), "chosen", x), ring(state.focused, marked(state.focused), "focused", x));
  traces.push(...publishedTraces(timed, untimed, x));
  const margin = { l: 62, r: !published.length ? 16 : WIDE() ? 150 : 104, b: 56, t: 14 }, { clientWidth, clientHeight } = $("plot");
  const size = [clientWidth - margin.l - margin.r, clientHeight - margin.t - margin.b];
  const layout = {
    xaxis: x.axis, yaxis, margin, hovermode: "closest", dragmode: WIDE() ? "zoom" : false, showlegend: false,
    paper_bgcolor: "#fff", plot_bgcolor: "#fff",
    font: { family: "system-ui, sans-serif", size: WIDE() ? 13 : 11, color: "#1d2430" },
    shapes: [...(untimed.length ? [band(x)] : []), ...(canDiffer() ? [level()] : [])],
    annotations: publishedLabels(timed, untimed, x, yaxis.range, size), uirevision: `${state.panel} ${state.metric} ${state.cost} ${byDifference()} ${state.only}`,
  };
  home = { x: x.range, y: yaxis.range };
  // what its buttons do, keys and pointers do; the picture lies beside this page
  Plotly.react($("plot"), traces.filter((trace) => trace.x.length || trace.name === "chosen"), layout, { responsive: true, displaylogo: false, displayModeBar: false });
  $("plot-note").textContent = noteOn(numbers, published);
}

function noteOn(numbers, published) {
  const all = members().length, missing = all - numbers.length, notes = [];
  const left = panel().members.filter((number) => !members().includes(number));
  if (left.length) notes.push(`3D only leaves out what has views and no field: ${left.slice(0, 6).map(nameOf).join(", ")}${left.length > 6 ? ` and ${left.length - 6} more` : ""}.`);
  if (!canDiffer()) notes.push(noReference());
  else if (!many() && !numbers.some((number) => reach(number).length)) notes.push(`${metricOf(state.metric).name}: no values of enough scenes, so no interval says which differences are noise.`);
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

// Why there is nothing that all are compared with.
function noReference() {
  const found = new Set(members().map((number) => data.configurations[number].reference).filter((number) => number !== null));
  return found.size > 1
    ? "Several models are here: bars are of the difference to the reference of each one's own model, and the axis has values."
    : "Nothing here is compared: there is no run of the reference with this metric.";
}

// How far the interval of the difference reaches below and above a point.
function reach(number) {
  const found = many() || !$("intervals").checked ? undefined : difference(number, state.metric);
  return found?.length === 3 ? [found[1] - found[0], found[2] - found[0]] : [];
}

function bars(numbers, colour) {
  const found = numbers.map(reach);
  return {
    type: "data", symmetric: false, array: found.map((ends) => ends[1] ?? 0), arrayminus: found.map((ends) => -(ends[0] ?? 0)),
    color: colour, thickness: 1.4, width: 4, visible: found.some((ends) => ends.length),
  };
}

const many = () => points().length > data.webgl_above;

function pointTrace(numbers, colours, x, dominated) {
  const own = numbers.map((number) => colours.get(colourValue(number)));
  const one = new Set(own).size === 1 ? own[0] : "#5c6675"; // bars of a trace have one colour
  const adaptive = numbers.map((number) => data.configurations[number].adaptive);
  const symbol = numbers.map((number) => `${shapeOf(number)}${data.configurations[number].failed ? "-open" : ""}`);
  return {
    type: many() && webgl ? "scattergl" : "scatter", mode: "markers", x: numbers.map((number) => x.at(mean(number, state.cost))), y: numbers.map(height),
    customdata: numbers, hoverinfo: "none", meta: dominated ? "dominated" : "frontier",
    marker: {
      color: dominated ? own.map((colour) => faint(colour, 0.45)) : own, size: dominated ? 10 : 13, symbol,
      line: { width: adaptive.map((is) => (is ? 2.5 : dominated ? 0 : 1)), color: adaptive.map((is) => (is ? "#1d2430" : "#fff")) },
    },
    error_y: bars(numbers, dominated ? faint(one, 0.35) : one),
  };
}

function frontierTrace(numbers, x) {
  const at = numbers.map((number) => [x.at(mean(number, state.cost)), height(number)]);
  if (at.length) at.push([x.edge, at.at(-1)[1]]);
  return {
    type: "scatter", mode: "lines", x: at.map(([cost]) => cost), y: at.map(([, quality]) => quality),
    line: { shape: "hv", color: "#1d2430", width: 1.6 }, hoverinfo: "skip", meta: "step",
  };
}

function ring(number, there, meta, x) {
  return {
    type: "scatter", mode: "markers", name: meta, hoverinfo: "skip", meta,
    x: there ? [x.at(mean(number, state.cost))] : [], y: there ? [height(number)] : [],
    marker: { size: meta === "chosen" ? 22 : 26, color: "rgba(0,0,0,0)", line: { width: 2.5, color: meta === "chosen" ? "#1d2430" : "#0b62b8" } },
  };
}

// Where the reference is.
function level() {
  const at = byDifference() ? 0 : mean(panel().reference, state.metric);
  return { type: "line", xref: "paper", x0: 0, x1: 1, yref: "y", y0: at, y1: at, line: { color: "#1d2430", width: 1, dash: "4px,4px" }, layer: "below" };
}

function publishedTraces(timed, untimed, x) {
  const trace = (entries, place, meta) => ({
    type: "scatter", mode: "markers", meta,
    x: entries.map(place), y: entries.map((entry) => entry.metrics[state.metric]), customdata: entries.map((entry) => ({ published: entry })),
    hoverinfo: "none", cliponaxis: false, marker: { symbol: "diamond-open", size: 10, color: "#6b4a00", line: { width: 1.6 } },
  });
  const column = () => 10 ** (x.range[1] - ((1 - x.share) / 2) * (x.range[1] - x.range[0]));
  return [trace(timed, (entry) => x.at(entry.costs[state.cost]), "published"), trace(untimed, column, "published without a cost")];
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
