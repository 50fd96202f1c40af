// The keyboard: arrows go from point to point and from row to row, Enter opens, Escape closes.
let byKeyboard = false;
document.addEventListener("keydown", () => (byKeyboard = true), true);
document.addEventListener("pointerdown", () => (byKeyboard = false), true);

function screenPlace(number) {
  const { _size, xaxis, yaxis } = $("plot")._fullLayout, { left, top } = $("plot").getBoundingClientRect();
  const x = axisOf(points()).at(mean(number, state.cost));
  return [left + _size.l + xaxis.d2p(x), top + _size.t + yaxis.d2p(height(number))];
}

function attend(number) {
  state.focused = number;
  drawAll();
  if (number === null) return hideTip();
  showTip(number, ...screenPlace(number));
  $("plot-said").textContent = [nameOf(number), plain(state.metric, mean(number, state.metric)), verdict(number, state.metric), plain(state.cost, mean(number, state.cost))].filter(Boolean).join(", ");
}

// The next point to the right or left by cost, up or down by quality; of equals each in turn.
function neighbour(number, along, step) {
  const of = along === "cost" ? (each) => mean(each, state.cost) : (each) => sign(state.metric) * mean(each, state.metric);
  const order = shownPoints().sort((a, b) => of(a) - of(b) || a - b);
  return order[Math.max(0, Math.min(order.length - 1, order.indexOf(number) + step))];
}

function zoom(factor) {
  const around = ([low, high]) => [low, high].map((end) => (low + high) / 2 + ((end - (low + high) / 2) * factor));
  const { xaxis, yaxis } = $("plot")._fullLayout;
  Plotly.relayout($("plot"), factor === 0 ? { "xaxis.range": home.x, "yaxis.range": home.y } : { "xaxis.range": around(xaxis.range), "yaxis.range": around(yaxis.range) });
}

function movePoint(event) {
  const steps = { ArrowRight: ["cost", 1], ArrowLeft: ["cost", -1], ArrowUp: ["quality", 1], ArrowDown: ["quality", -1] }[event.key];
  const there = shownPoints();
  if (!there.length || event.target !== $("plot") || event.ctrlKey || event.metaKey || event.altKey) return;
  const at = there.includes(state.focused) ? state.focused : null;
  if (steps) attend(at === null ? neighbour(null, "cost", 1) : neighbour(at, ...steps));
  else if (event.key === "Home" || event.key === "End") attend(neighbour(null, "cost", event.key === "Home" ? 1 : Infinity));
  else if ((event.key === "Enter" || event.key === " ") && at !== null) choose(at);
  else if ("+=-0".includes(event.key)) zoom({ "+": 0.7, "=": 0.7, "-": 1 / 0.7, 0: 0 }[event.key]);
  else return;
  event.preventDefault();
}

function moveRow(event) {
  const row = event.target.closest("tbody tr");
  if (!row || event.target !== row) return;
  if (event.key === "Enter") row.click();
  else if (event.key === "ArrowDown") row.nextElementSibling?.focus();
  else if (event.key === "ArrowUp") row.previousElementSibling?.focus();
  else return;
  event.preventDefault();
}

function moveCard(event) {
  const step = { ArrowRight: "nextElementSibling", ArrowLeft: "previousElementSibling" }[event.key];
  const card = step && event.target.closest(".card")?.[step];
  if (!card) return;
  event.preventDefault();
  card.focus();
}

function connectKeys() {
  $("plot").onkeydown = movePoint;
  $("plot").onfocus = () => byKeyboard && shownPoints().includes(state.focused) && attend(state.focused);
  $("plot").onblur = () => state.focused !== null && byKeyboard && attend(null);
  $("table-section").onkeydown = moveRow;
  $("metrics").onkeydown = moveCard;
  document.addEventListener("keydown", (event) => {
    if (event.key !== "Escape") return;
    if (!$("tip").hidden) hideTip();
    else if (!$("details").hidden) choose(null);
  });
}
