// What is known of a configuration or of a failed run: numbers, pictures, overrides, commands.
function panelOf(title, ...content) {
  const close = element("button", { className: "close", type: "button", textContent: "✕", title: "close (Escape)", ariaLabel: "close", onclick: () => choose(null) });
  $("details").replaceChildren(close, element("h2", {}, title), ...content.filter(Boolean));
  $("details").hidden = false;
  $("details").scrollTop = 0;
}

function numbers(number) {
  const { reference } = data.configurations[number], compared = reference !== null && reference !== number;
  const rows = [...data.metrics, ...data.costs].filter(({ field }) => value(number, field));
  const cells = (tag, texts) => element("tr", {}, ...texts.map((text, at) => element(at ? tag : "th", {}, text)));
  const line = ({ field, name }) => [name, plain(field, mean(number, field)), ...(compared ? [metricOf(field) ? differenceText(number, field, false) : ""] : [])];
  return element("table", {}, ...(compared ? [cells("th", ["", "", `to ${referenceName(number)}`])] : []), ...rows.map((row) => cells("td", line(row))));
}

function commandOf(run) {
  if (!run.command) return element("p", { className: "note" }, "Its command was not recorded.");
  return element("div", {}, element("pre", { className: "command" }, run.command), copyButton(run.command, "copy"));
}

function picturesOf(run, small) {
  const found = [];
  const readable = (path) => {
    try {
      return decodeURI(path);
    } catch {
      return path; // a name that is no UTF-8
    }
  };
  const told = (shown, what, path) => {
    const words = `The ${what} is not where it was when this page was written: ${readable(path)}`;
    shown.onerror = () => shown.replaceWith(element("p", { className: "note" }, words));
    return shown;
  };
  if (run.sheet || small) {
    const image = told(element("img", { src: small ?? run.sheet, alt: "contact sheet" }), "contact sheet", run.sheet ?? "");
    found.push(run.sheet ? element("a", { href: run.sheet, target: "_blank", title: "the contact sheet in full" }, image) : image);
  }
  if (run.orbit) {
    const video = element("video", { src: run.orbit, controls: true, loop: true, muted: true, preload: "metadata" });
    found.push(told(video, "orbit video", run.orbit));
  }
  if (!found.length) found.push(element("p", { className: "note" }, "It left no pictures that are still there."));
  const folder = run.folder && element("a", { href: run.folder, target: "_blank" }, "its folder");
  if (folder) found.push(element("p", { className: "note" }, folder));
  return found;
}

function showConfiguration(number, seed = 0) {
  const entry = data.configurations[number], run = entry.runs[seed];
  const seeds = element("p", { className: "seeds" }, "seed ");
  entry.runs.forEach((each, at) => {
    const button = element("button", { type: "button", textContent: each.seed ?? "none", onclick: () => showConfiguration(number, at) });
    button.setAttribute("aria-pressed", at === seed);
    seeds.append(button, " ");
  });
  const bad = (words) => element("p", { className: "bad" }, words);
  const failed = entry.failed ? bad(`${entry.failed} run${entry.failed > 1 ? "s" : ""} of this configuration failed.`) : null;
  const fell = entry.fell_back ? bad(entry.fell_back) : null;
  const pictures = picturesOf(run, seed === 0 ? entry.small : null);
  const { strategy, ...others } = entry.labels;
  const all = Object.entries(others).map(([key, word]) => `${key}=${word}`).join("  ");
  panelOf(nameOf(number), element("p", { className: "words" }, all), failed, fell, seeds, ...pictures, commandOf(run), numbers(number), spending(number), overrideList(entry));
}

function showFailure(entry) {
  const where = [entry.strategy, entry.seed === null ? null : `seed ${entry.seed}`, entry.device, entry.time].filter(Boolean).join(", ");
  const reason = element("p", { className: "bad" }, entry.error ?? "no reason was recorded");
  const note = element("p", { className: "note" }, where);
  panelOf([entry.status, entry.strategy].filter(Boolean).join(": "), reason, note, commandOf(entry), overrideList(entry));
}

// Beside any device: failures before there was one, and on devices on which nothing succeeded.
function drawFailures() {
  const devices = data.panels.map(({ device }) => device);
  const shown = data.failures.filter(({ device }) => !devices.includes(device) || device === panel().device);
  $("failed").hidden = !shown.length;
  $("failed-count").textContent = `(${shown.length})`;
  $("failed-strip").replaceChildren(...shown.map((entry) => {
    const seed = entry.seed === null ? "" : `, seed ${entry.seed}`;
    const text = ` ${entry.strategy ?? ""}${seed}: ${entry.error ?? "no reason was recorded"}`;
    const chip = element("button", { type: "button", title: words(entry).join("\n") }, element("b", {}, `✕ ${entry.status}`), text);
    chip.onclick = () => showFailure(entry);
    return chip;
  }));
}
