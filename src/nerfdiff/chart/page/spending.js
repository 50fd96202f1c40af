// What was spent on each scene of a configuration, beside how hard the scene is: the PSNR that the reference has on it.
const WIDTH = 360, HEIGHT = 190, EDGE = { left: 46, right: 12, top: 10, bottom: 34 };
const SPENT = { distill: ["seconds of distillation", "s"], denoiser_calls: ["denoiser calls", ""] };

function spending(number) {
  const found = data.configurations[number].spending; // by what was spent
  if (!found) return null;
  const wanted = state.cost === "denoiser_calls" ? ["denoiser_calls", "distill"] : ["distill", "denoiser_calls"];
  const field = wanted.find((name) => found[name]), [name, unit] = SPENT[field];
  const lines = wanted.filter((each) => found[each]).map((each) => `${SPENT[each][0]} ${rho(found[each])}`);
  return element(
    "section", { className: "spending" }, element("h3", {}, "Spending against difficulty"), scatter(found[field], name, unit),
    element("p", { className: "note" }, `Spearman's ρ of what a scene took with its difficulty, which is a low PSNR of ${referenceName(number)}: ${lines.join(", ")}.`),
  );
}

const rho = (found) => (found.rho === null ? "– (the same for all scenes)" : `${found.rho < 0 ? "−" : "+"}${Math.abs(found.rho).toFixed(2)}`);

function scatter({ scenes, psnr, spent }, name, unit) {
  const [easy, hard] = [Math.max(...psnr), Math.min(...psnr)], high = 1.08 * Math.max(...spent) || 1;
  const x = (at) => EDGE.left + ((easy - at) / (easy - hard || 1)) * (WIDTH - EDGE.left - EDGE.right - 12) + 6;
  const y = (at) => HEIGHT - EDGE.bottom - (at / high) * (HEIGHT - EDGE.top - EDGE.bottom);
  const ink = "#5c6675", text = (content, attributes) => svg("text", { fill: ink, ...attributes }, content);
  const floor = HEIGHT - EDGE.bottom, top = Math.max(...spent);
  const parts = [
    svg("path", { d: `M${EDGE.left},${EDGE.top}V${floor}H${WIDTH - EDGE.right}`, fill: "none", stroke: ink }),
    text("0", { x: EDGE.left - 6, y: floor + 4, "text-anchor": "end" }), text(digits(top, unit), { x: EDGE.left - 6, y: y(top) + 4, "text-anchor": "end" }),
    text(`${easy.toFixed(1)} dB`, { x: EDGE.left, y: floor + 14 }), text(`${hard.toFixed(1)} dB`, { x: WIDTH - EDGE.right, y: floor + 14, "text-anchor": "end" }),
    text("harder →", { x: (EDGE.left + WIDTH) / 2, y: floor + 28, "text-anchor": "middle" }),
    ...scenes.map((scene, at) => svg("circle", { cx: x(psnr[at]), cy: y(spent[at]), r: 4, fill: "#0b62b8", "fill-opacity": 0.7 }, svg("title", {}, `${scene}: ${digits(spent[at], unit)}, ${psnr[at].toFixed(2)} dB`))),
  ];
  return svg("svg", { id: "scatter", viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": `${name} of each scene against its difficulty` }, ...parts);
}
