// What the page knows (`data`), what is chosen (`state`), and words for both.
const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const state = {
  panel: 0, metric: null, cost: null, colour: "strategy", axis: "difference", only: "3d", chosen: null, focused: null, hidden: new Set(), within: {},
};
for (const metric of data.metrics) state.within[metric.field] = metric.within;

const metricOf = (field) => data.metrics.find((metric) => metric.field === field);
const costOf = (field) => data.costs.find((cost) => cost.field === field);
const panel = () => data.panels[state.panel];
const value = (number, field) => data.configurations[number].values[field]; // [mean] or [mean, low, high]
const mean = (number, field) => value(number, field)?.[0];
const both = (number) => value(number, state.metric) && value(number, state.cost);
const sign = (field) => (metricOf(field).better === "higher" ? 1 : -1);
const words = (entry) => entry.overrides.map((number) => data.words[number]);

// Computed once for each choice: whoever asks for thousands of points one by one asks often.
const kept = {};
function once(name, make) {
  const choice = `${state.panel} ${state.only} ${state.metric} ${state.cost}`;
  if (kept[name]?.choice !== choice) kept[name] = { choice, value: make() };
  return kept[name].value;
}

// Those that leave a field: all of them where the switch is off, and where nobody does.
const solid = () => once("solid", () => panel().members.filter((number) => data.configurations[number].solid));
const only3d = () => state.only === "3d" && solid().length > 0;
const members = () => (only3d() ? solid() : panel().members);
const points = () => once("points", () => members().filter(both));
const frontierOf = (metric, cost) => panel()[only3d() ? "frontiers_3d" : "frontiers"][metric]?.[cost] ?? [];
const answers = () => panel().answers[only3d() ? "3d" : "all"];

// Differences to the reference: [mean, low, high], or [mean] where there is no interval.
const difference = (number, field) => data.configurations[number].differences[field];
const referenceName = (number) => nameOf(data.configurations[number].reference);
const canDiffer = () => panel().reference !== null && value(panel().reference, state.metric) !== undefined;
const byDifference = () => state.axis === "difference" && canDiffer() && !$("published").checked;
const height = (number) => mean(number, state.metric) - (byDifference() ? mean(panel().reference, state.metric) : 0);

// What the interval of the difference says, and no more than that.
function verdict(number, field) {
  const { reference } = data.configurations[number], found = difference(number, field);
  if (number === reference) return "the reference";
  if (!found) return "";
  if (found.length < 3) return "no interval";
  const ends = [sign(field) * found[1], sign(field) * found[2]];
  const says = Math.min(...ends) > 0 ? "better than" : Math.max(...ends) < 0 ? "worse than" : "level with";
  return `${says} ${referenceName(number)}`;
}

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

const nameOf = (number) => data.configurations[number].name;

function digits(number, unit) {
  if (number === 0) return "0";
  const size = Math.abs(number);
  const text = size >= 1e5 ? number.toExponential(2) : size >= 100 ? number.toFixed(0) : Number(number.toPrecision(3)).toString();
  return unit ? `${text} ${unit}` : text;
}
const metricText = (field, number) => `${number.toFixed(metricOf(field).digits)} ${metricOf(field).unit}`.trim();
const costText = (field, number) => digits(number, costOf(field).unit);
const plain = (field, number) => (metricOf(field) ? metricText(field, number) : costText(field, number));

function differenceText(number, field, unit = true) {
  const found = difference(number, field), { digits: after, unit: name } = metricOf(field);
  if (!found) return "–";
  const text = (each) => `${each < 0 ? "−" : "+"}${Math.abs(each).toFixed(after)}`;
  return `${text(found[0])}${unit && name ? ` ${name}` : ""}${found.length > 1 ? ` [${text(found[1])}, ${text(found[2])}]` : ""}`;
}

// Overrides as a list: those that tell configurations apart first, in bold.
function overrideList(entry, short = false) {
  const labels = entry.labels ?? {};
  const told = (word) => Object.keys(labels).some((key) => `.${word.split("=")[0].replace(/^\++/, "")}`.endsWith(`.${key}`));
  const all = words(entry);
  const lines = [...all.filter(told), ...(short ? [] : all.filter((word) => !told(word)))];
  return element("ul", { className: "words" }, ...lines.map((word) => element("li", {}, told(word) ? element("b", {}, word) : word)));
}
