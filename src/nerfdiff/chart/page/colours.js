// A colour for every value of the setting that points are coloured by.
const KINDS = ["#0b62b8", "#d1570a", "#1a8a5a", "#8a4fbf", "#b3261e", "#0f8fa3", "#8a6d1d", "#c2408f", "#5c6675", "#5d8a00"];
const SCALE = ["#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#c9a800"];
const OTHER = "#9aa3af";
const TOLD = 8; // numbers in the legend at most, of which people see the scale between
const UNSET = "not set";

const colourValue = (number) => data.configurations[number].labels[state.colour] ?? UNSET;

function mix(share) {
  const place = share * (SCALE.length - 1), low = Math.min(Math.floor(place), SCALE.length - 2);
  const parts = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
  const [from, to] = [parts(SCALE[low]), parts(SCALE[low + 1])];
  return `rgb(${from.map((part, at) => Math.round(part + (to[at] - part) * (place - low))).join(",")})`;
}

// {numeric, groups}, the groups in the order of the legend: numbers along a scale, of which not all stand there, or words
// by kind, of which those beyond the colours are one.
function colouring(numbers) {
  const found = [...new Set(numbers.map(colourValue))];
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
