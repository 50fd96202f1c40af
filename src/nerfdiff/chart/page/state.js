// What the page knows (`data`), what is chosen (`state`), and words for both.
const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const state = { panel: 0, metric: null, cost: null, colour: "strategy", chosen: null, within: {}, switched: false };
for (const metric of data.metrics) state.within[metric.field] = metric.within;

const metricOf = (field) => data.metrics.find((metric) => metric.field === field);
const costOf = (field) => data.costs.find((cost) => cost.field === field);
const panel = () => data.panels[state.panel];
const value = (number, field) => data.configurations[number].values[field]; // [mean] or [mean, low, high]
const mean = (number, field) => value(number, field)?.[0];
const both = (number) => value(number, state.metric) && value(number, state.cost);
const points = () => panel().members.filter(both);
const frontierOf = (metric, cost) => panel().frontiers[metric]?.[cost] ?? [];
const sign = (field) => (metricOf(field).better === "higher" ? 1 : -1);
const words = (entry) => entry.overrides.map((number) => data.words[number]);

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

function estimate(field, values) {
  const text = (number) => (metricOf(field) ? number.toFixed(metricOf(field).digits) : digits(number));
  const unit = (metricOf(field) ?? costOf(field)).unit;
  const ends = values.length > 1 && text(values[1]) !== text(values[2]) ? ` [${text(values[1])}, ${text(values[2])}]` : "";
  return `${text(values[0])}${ends}${unit ? ` ${unit}` : ""}`;
}

// Overrides as a list: those that tell configurations apart first, in bold.
function overrideList(entry) {
  const labels = entry.labels ?? {};
  const told = (word) => Object.keys(labels).some((key) => `.${word.split("=")[0].replace(/^\++/, "")}`.endsWith(`.${key}`));
  const all = words(entry);
  const lines = [...all.filter(told), ...all.filter((word) => !told(word))];
  return element("ul", { className: "words" }, ...lines.map((word) => element("li", {}, told(word) ? element("b", {}, word) : word)));
}
