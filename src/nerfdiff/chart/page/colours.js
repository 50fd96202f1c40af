// A colour for every value of the setting that points are coloured by; a shape for every strategy.
const KINDS = data.kinds, OTHER = data.other;
const SCALE = ["#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#c9a800"];
const TOLD = 8; // numbers in the legend at most, of which people see the scale between
const UNSET = "not set";

const shapeOf = (number) => data.marks[data.configurations[number].strategy][1];

// Beside the labels: the kind of field, which a checkpoint's name may hide, and whether the budget follows the scene.
const FACTS = {
  strategy: (entry) => entry.strategy,
  field: (entry) => entry.labels.field ?? entry.field,
  budget: (entry) => entry.labels.budget ?? (entry.adaptive ? "adaptive" : "fixed"),
};
const colourValue = (number) => {
  const entry = data.configurations[number];
  return (FACTS[state.colour] ? FACTS[state.colour](entry) : entry.labels[state.colour]) ?? UNSET;
};

function colourKeys() {
  const entries = panel().members.map((number) => data.configurations[number]);
  const keys = new Set(["strategy", ...entries.flatMap(({ labels }) => Object.keys(labels))]);
  if (entries.some(({ field }) => field)) keys.add("field");
  if (entries.some(({ adaptive }) => adaptive)) keys.add("budget");
  return [...keys];
}

function mix(share) {
  const place = share * (SCALE.length - 1), low = Math.min(Math.floor(place), SCALE.length - 2);
  const parts = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
  const [from, to] = [parts(SCALE[low]), parts(SCALE[low + 1])];
  return `rgb(${from.map((part, at) => Math.round(part + (to[at] - part) * (place - low))).join(",")})`;
}

// {numeric, groups}, the groups in the order of the legend: numbers along a scale, of which not all stand there, or words
// by kind, of which those beyond the colours are one. Strategies have the colours of their marks, in every panel.
function colouring(numbers) {
  const found = [...new Set(numbers.map(colourValue))];
  if (state.colour === "strategy")
    return { numeric: false, groups: found.sort().map((word) => ({ words: [word], colour: data.marks[word][0], legend: word })) };
  const numeric = found.filter((word) => word !== UNSET && word !== "" && isFinite(word)).sort((a, b) => a - b);
  const unset = found.includes(UNSET) ? [{ words: [UNSET], colour: OTHER, legend: UNSET }] : [];
  if (numeric.length > 1 && numeric.length >= found.filter((word) => word !== UNSET).length) {
    const every = Math.ceil((numeric.length - 1) / (TOLD - 1));
    const told = (at) => at % every === 0 || at === numeric.length - 1;
    const scaled = numeric.map((word, at) => ({ words: [word], colour: mix(at / (numeric.length - 1)), legend: told(at) ? word : null }));
    return { numeric: true, groups: [...scaled, ...unset] };
  }
  const sorted = found.filter((word) => word !== UNSET).sort();
  const kinds = sorted.slice(0, KINDS.length).map((word, at) => ({ words: [word], colour: KINDS[at], legend: word }));
  const rest = sorted.slice(KINDS.length);
  const others = rest.length ? [{ words: rest, colour: OTHER, legend: `${rest.length} others` }] : [];
  return { numeric: false, groups: [...kinds, ...others, ...unset] };
}

function faint(colour, alpha) {
  const parts = colour.startsWith("#") ? [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16)) : colour.match(/\d+/g);
  return `rgba(${parts.join(",")},${alpha})`;
}
