// Choices, and what follows from each.
function fill(select, options, chosen) {
  select.replaceChildren(...options.map(([key, text]) => element("option", { value: key, textContent: text })));
  select.value = chosen;
  select.disabled = options.length < 2;
}

let opener = null; // what had the keyboard's attention before the details opened

function choose(number, scroll = false) {
  state.chosen = number;
  if (number === null) closeDetails();
  else {
    if ($("details").hidden) opener = document.activeElement;
    showConfiguration(number);
    if (byKeyboard) $("details").querySelector(".close").focus();
  }
  drawAll();
  if (scroll && WIDE()) $("view").scrollIntoView({ behavior: "smooth", block: "nearest" });
}

function closeDetails() {
  const within = $("details").contains(document.activeElement);
  $("details").hidden = true;
  if (within) (opener?.isConnected ? opener : $("plot")).focus();
}

function firstOf(all, there, wanted) {
  const fields = all.map(({ field }) => field).filter(there);
  return fields.includes(wanted) ? wanted : (fields[0] ?? all[0].field);
}

// After the device or the test images changed: what is not there any more gives way to what is.
function settle() {
  const own = members(), has = (field) => own.some((number) => value(number, field));
  state.metric = firstOf(data.metrics, has, state.metric);
  state.cost = firstOf(data.costs, has, state.cost);
  const devices = [...new Set(data.panels.map(({ device }) => device))];
  fill($("device"), devices.map((device) => [device, device]), panel().device);
  const tests = data.panels.map(({ device, test }, at) => [device, String(at), test]).filter(([device]) => device === panel().device);
  fill($("test"), tests.map(([, at, test]) => [at, test]), String(state.panel));
  fill($("cost"), data.costs.filter(({ field }) => has(field)).map(({ field, name }) => [field, name]), state.cost);
  const keys = colourKeys();
  if (!keys.includes(state.colour)) state.colour = "strategy";
  fill($("colour"), keys.map((key) => [key, key]), state.colour);
  $("published-switch").hidden = !panel().published.length;
  $("only-switch").hidden = solid().length === panel().members.length;
  $("only").checked = only3d();
  $("only").disabled = !solid().length;
  settleAxis();
}

// Differences are shown where all are compared with one reference; published values are none.
function settleAxis() {
  const shown = [...(panel().reference === null || $("published").checked ? [] : [["difference", `difference to ${nameOf(panel().reference)}`]]), ["value", "value"]];
  fill($("axis"), shown, shown.some(([key]) => key === state.axis) ? state.axis : "value");
}

function drawAll() {
  draw();
  listen();
}

// What is chosen stands in the address, so that a link shows the same.
const REMEMBERED = ["panel", "metric", "cost", "colour", "axis", "only"];

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
  state.focused = null;
  hideTip();
  if ("panel" in changes || "only" in changes) {
    if ("panel" in changes || !members().includes(state.chosen)) {
      state.chosen = null;
      closeDetails();
    }
    settle();
    drawPicks();
    drawFailures();
  }
  if (["panel", "only", "metric", "cost"].some((name) => name in changes)) drawTable();
  drawCards();
  drawAdvice();
  drawAll();
  remember();
}

function connect() {
  $("device").onchange = () => change({ panel: data.panels.findIndex(({ device }) => device === $("device").value) });
  $("test").onchange = () => change({ panel: Number($("test").value) });
  $("cost").onchange = () => change({ cost: $("cost").value });
  $("colour").onchange = () => change({ colour: $("colour").value });
  $("intervals").onchange = drawAll;
  $("axis").onchange = () => change({ axis: $("axis").value });
  $("only").onchange = () => change({ only: $("only").checked ? "3d" : "all" });
  $("published").onchange = () => {
    settleAxis();
    drawAll();
  };
  $("within").oninput = () => {
    const within = Number($("within").value);
    if ($("within").value === "" || !(within >= 0)) return;
    state.within[state.metric] = within;
    drawAdvice();
  };
  $("csv").onclick = saveCsv;
  connectKeys();
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
