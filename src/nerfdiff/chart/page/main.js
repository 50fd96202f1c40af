// Choices, and what follows from each.
function fill(select, options, chosen) {
  select.replaceChildren(...options.map(([key, text]) => element("option", { value: key, textContent: text })));
  select.value = chosen;
  select.disabled = options.length < 2;
}

function choose(number, scroll = false) {
  state.chosen = number;
  if (number === null) $("details").hidden = true;
  else showConfiguration(number);
  drawAll();
  if (scroll && WIDE()) $("view").scrollIntoView({ behavior: "smooth", block: "nearest" });
}

function firstOf(all, there, wanted) {
  const fields = all.map(({ field }) => field).filter(there);
  return fields.includes(wanted) ? wanted : (fields[0] ?? all[0].field);
}

// After the device or the test images changed: what is not there any more gives way to what is.
function settle() {
  const members = panel().members, has = (field) => members.some((number) => value(number, field));
  state.metric = firstOf(data.metrics, has, state.metric);
  state.cost = firstOf(data.costs, has, state.cost);
  const devices = [...new Set(data.panels.map(({ device }) => device))];
  fill($("device"), devices.map((device) => [device, device]), panel().device);
  const tests = data.panels.map(({ device, test }, at) => [device, String(at), test]).filter(([device]) => device === panel().device);
  fill($("test"), tests.map(([, at, test]) => [at, test]), String(state.panel));
  fill($("cost"), data.costs.filter(({ field }) => has(field)).map(({ field, name }) => [field, name]), state.cost);
  const keys = [...new Set(members.flatMap((number) => Object.keys(data.configurations[number].labels)))];
  if (!keys.includes(state.colour)) state.colour = "strategy";
  fill($("colour"), keys.map((key) => [key, key]), state.colour);
  $("published-switch").hidden = !panel().published.length;
}

function drawAll() {
  draw();
  listen();
}

// What is chosen stands in the address, so that a link shows the same.
const REMEMBERED = ["panel", "metric", "cost", "colour"];

function remember() {
  history.replaceState(null, "", `#${new URLSearchParams(REMEMBERED.map((name) => [name, state[name]]))}`);
}

// The panel that the address asks for, when the page opens and when the address changes; what else it asks for is settled
// as any choice that is not there.
function recall() {
  const asked = Object.fromEntries(new URLSearchParams(location.hash.slice(1)));
  for (const name of REMEMBERED.slice(1)) state[name] = asked[name] ?? state[name];
  return Number(asked.panel) in data.panels ? Number(asked.panel) : 0;
}

function change(changes) {
  Object.assign(state, changes);
  if ("panel" in changes) {
    state.chosen = null;
    $("details").hidden = true;
    settle();
    drawTable();
    drawFailures();
  } else if ("metric" in changes || "cost" in changes) table.rows().invalidate().draw(false);
  drawCards();
  drawPick();
  drawAll();
  remember();
}

function connect() {
  $("device").onchange = () => change({ panel: data.panels.findIndex(({ device }) => device === $("device").value) });
  $("test").onchange = () => change({ panel: Number($("test").value) });
  $("cost").onchange = () => change({ cost: $("cost").value });
  $("colour").onchange = () => change({ colour: $("colour").value });
  $("intervals").onchange = drawAll;
  $("published").onchange = () => {
    state.switched = true;
    drawAll();
  };
  $("within").oninput = () => {
    const within = Number($("within").value);
    if ($("within").value === "" || !(within >= 0)) return;
    state.within[state.metric] = within;
    drawPick();
  };
  $("csv").onclick = saveCsv;
  wide.onchange = drawAll;
  window.onhashchange = () => change({ panel: recall() }); // which remember() does not cause
  // opening the details narrows the plot, which Plotly sees only of windows
  new ResizeObserver(() => $("plot").on && Plotly.Plots.resize($("plot"))).observe($("plot-box"));
}

$("counts").textContent = data.counts;
$("how").textContent = data.how;
$("unread").hidden = !data.unread.length;
$("unread").replaceChildren(...data.unread.map((line) => element("li", {}, line)));
drawStability();
$("rewards").hidden = !data.rewards;
$("rewards").textContent = data.rewards ?? "";
$("empty").hidden = !data.empty;
$("empty").textContent = data.empty ?? "";
if (data.panels.length) {
  await loadTables();
  $("chart").hidden = $("table-section").hidden = false;
  connect();
  change({ panel: recall() });
} else drawFailures();
document.body.dataset.ready = "yes";
