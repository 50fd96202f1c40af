// Where strategies break: a heat map of breaking points, and curves over severity.
// Cividis, which people with and without colour blindness see alike; the darker, the sooner it breaks.
const HEAT = ["#00204d", "#3b496c", "#7f7c75", "#bcaf6f", "#ffea46"];
let study = null;

const heatOf = (share) => HEAT[Math.min(HEAT.length - 1, Math.floor(share * HEAT.length))];
const inkOf = (share) => (share < 0.6 ? "#fff" : "#1d2430");

function drawStability() {
  $("stability").hidden = !data.stability.length;
  if (!data.stability.length) return;
  $("rules").textContent = data.stability[0].rules;
  $("study-choice").hidden = data.stability.length < 2;
  fill($("study"), data.stability.map(({ settings }, at) => [String(at), settings.join(" ")]), "0");
  $("study").onchange = () => showStudy(Number($("study").value));
  const shares = ["at the first severity", "", "", "", "not within what was tested"];
  $("heat-legend").replaceChildren("It breaks ", ...HEAT.flatMap((colour, at) => {
    const swatch = element("span", { className: "swatch" });
    swatch.style.background = colour;
    return [swatch, `${shares[at]} `];
  }));
  showStudy(0);
}

function showStudy(number) {
  study = data.stability[number];
  const { silent, silent_lost: lost, broken } = study;
  $("silent").className = silent ? "bad" : "";
  const told = `with status ok, and the judge said ok; ${lost} by rule (b), ${silent - lost} by rule (c) alone`;
  $("silent").replaceChildren(element("b", {}, `Silent failures: ${silent} of ${broken} broken scenes`), silent ? ` (${told})` : "");
  $("curve-box").hidden = true;
  const head = element("tr", {}, element("th", { scope: "col" }, "axis"), ...study.strategies.map((name) => element("th", { scope: "col" }, name)));
  const clean = element("tr", {}, element("th", { scope: "row" }, "clean PSNR, dB"), ...study.strategies.map((name) => element("td", {}, study.clean[name]?.toFixed(2) ?? "–")));
  const rows = study.axes.map((axis) => element("tr", {}, element("th", { scope: "row", title: axis.source }, axis.name), ...study.strategies.map((name) => heatCell(axis, name))));
  $("heat").replaceChildren(element("thead", {}, head), element("tbody", {}, clean, ...rows));
}

function heatCell(axis, strategy) {
  const cell = axis.cells[strategy];
  if (!cell) return element("td", {}, "–");
  const silent = cell.silent ? element("small", {}, `● ${cell.silent} silent`) : null;
  const button = element("button", { type: "button", title: cell.full.join(" / ") }, cell.short.join(" / "), silent);
  button.style.background = heatOf(cell.share);
  button.style.color = inkOf(cell.share);
  button.dataset.axis = axis.axis;
  button.dataset.strategy = strategy;
  button.setAttribute("aria-pressed", "false");
  button.onclick = () => showCurve(axis, strategy, button);
  button.onkeydown = moveInHeat;
  return element("td", {}, button);
}

// The arrow keys go from cell to cell.
function moveInHeat(event) {
  const step = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] }[event.key];
  if (!step) return;
  event.preventDefault();
  const rows = [...$("heat").tBodies[0].rows], cell = event.currentTarget.parentElement;
  let [row, column] = [cell.parentElement.sectionRowIndex + step[0], cell.cellIndex + step[1]];
  while (rows[row]?.cells[column]) {
    const found = rows[row].cells[column].querySelector("button");
    if (found) return found.focus();
    [row, column] = [row + step[0], column + step[1]];
  }
}

function showCurve(axis, strategy, button) {
  for (const other of $("heat").querySelectorAll("button")) other.setAttribute("aria-pressed", other === button);
  $("curve-box").hidden = false;
  $("curve-title").textContent = `${axis.name}: ${strategy} breaks at ${axis.cells[strategy].full.join(" / ")}`;
  const places = [...new Set(study.strategies.flatMap((name) => axis.cells[name]?.points.map(({ text }) => text) ?? []))];
  const traces = study.strategies.filter((name) => axis.cells[name]).map((name, at) => curveTrace(axis.cells[name], name, KINDS[at % KINDS.length], name === strategy));
  const layout = {
    margin: { l: 56, r: 12, t: 10, b: 76 }, showlegend: true, legend: { orientation: "h", y: 1.02, yanchor: "bottom" },
    xaxis: { type: "category", categoryorder: "array", categoryarray: places, title: { text: "severity" }, fixedrange: !WIDE() },
    yaxis: { title: { text: "loss, dB" }, zeroline: true, zerolinecolor: "#1d2430", fixedrange: !WIDE() },
    font: { family: "system-ui, sans-serif", size: WIDE() ? 13 : 11, color: "#1d2430" }, paper_bgcolor: "#fff", plot_bgcolor: "#fff",
  };
  Plotly.react($("curve"), traces, layout, { responsive: true, displayModeBar: false });
  showBroken(axis, strategy);
  $("curve-title").focus({ preventScroll: true });
  $("curve-box").scrollIntoView({ behavior: "smooth", block: "nearest" });
}

function curveTrace(cell, name, colour, chosen) {
  const shown = cell.points.filter(({ loss }) => loss);
  const mean = ({ loss }) => loss[0], above = ({ loss }) => (loss[2] ?? loss[0]) - loss[0], below = ({ loss }) => loss[0] - (loss[1] ?? loss[0]);
  return {
    type: "scatter", mode: "lines+markers", name, x: shown.map(({ text }) => text), y: shown.map(mean), opacity: chosen ? 1 : 0.55,
    line: { color: colour, width: chosen ? 3 : 1.5, dash: chosen ? "solid" : "dot" },
    marker: { color: colour, size: 9, symbol: shown.map(({ broken }) => (broken ? "x" : "circle")) },
    error_y: { type: "data", symmetric: false, array: shown.map(above), arrayminus: shown.map(below), thickness: 1.2, width: 3, color: colour },
  };
}

function showBroken(axis, strategy) {
  const cell = axis.cells[strategy], found = [];
  for (const { words, strip, sheet } of cell.pictures) {
    found.push(element("p", {}, words));
    if (strip) found.push(element("img", { src: strip, alt: `${words}: clean above, broken below` }));
    if (sheet) found.push(element("p", { className: "note" }, element("a", { href: sheet, target: "_blank" }, "the whole contact sheet, with input and truth")));
  }
  $("curve-pictures").replaceChildren(...found);
  const heads = ["severity", "PSNR, dB", "without fallbacks", "loss, dB", "failed", "suspect", "broken", "silent"];
  const number = (value) => (value === null || value === undefined ? "–" : value.toFixed(2));
  const line = (point) => [point.text, number(point.psnr[0]), number(point.without), number(point.loss?.[0]), `${point.failed} of ${point.total}`, point.suspect, point.broken || "–", point.silent];
  const row = (tag, cells) => element("tr", {}, ...cells.map((cell) => element(tag, {}, String(cell))));
  const area = cell.area === null ? null : element("p", {}, `Loss over all severities: ${cell.area.toFixed(2)} times that of none.`);
  $("curve-points").replaceChildren(...[area, element("table", {}, row("th", heads), ...cell.points.map((point) => row("td", line(point))))].filter(Boolean));
}
