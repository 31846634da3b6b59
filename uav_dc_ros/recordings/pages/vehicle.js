// A real vehicle: what it did when, and why; how high it was, and how far from its cells.

function vehicle(journey) {
  const by = (name) => (row) => row[name];
  const { words, cells } = journey;
  const left = journey.words_total - words.length;
  return make("section", { "aria-labelledby": "vehicle-title" },
    make("h2", { id: "vehicle-title" }, "Vehicle"),
    make("p", { class: "note" }, "Times are seconds since its first word. A step is done when the vehicle is there, or when its time is over: then it may be far from its cell."),
    make("div", { class: "grid halves" },
      make("div", { class: "stack" },
        card("Altitude", make("div", { class: "chart", id: "altitude", style: "height: 230px" }),
          make("ul", { class: "legend" }, swatch("accent", "flown"), swatch("dock", "its cells"), words.some((word) => word.held) ? swatch("warm", "held: something kept it from going on") : null)),
        card("Distance from the centre of the cell, where it was measured", cells.step.length
          ? make("div", { class: "chart", id: "off" }) : make("p", { class: "note" }, "It never came to a cell."))),
      card("Phases", table([
        { name: "at, s", text: (row) => fixed(row.s, 1), value: by("s") },
        { name: "lasted, s", text: (row) => fixed(row.lasted_s, 1), value: by("lasted_s") },
        { name: "step", text: (row) => String(row.step), value: by("step") },
        { name: "phase", text: by("phase"), value: by("phase"), cls: "phase" },
        { name: "reason", text: (row) => (row.held ? make("b", { class: "bad" }, row.reason) : row.reason || NONE), cls: "text" },
      ], words, { label: "Phases", caption: left > 0 ? `${words.length} of ${journey.words_total}` : "" }))));
}

function swatch(name, text) {
  return make("li", {}, make("span", { class: "key", style: `background: var(--${name})` }), text);
}

function drawVehicle(journey) {
  const { words, way, cells } = journey;
  const end = Math.max(1, ...way.s, ...words.map((word) => word.s));
  const seconds = (more) => axis({ range: [0, end], zeroline: false, nticks: 8, ...more });
  // A hold lasts until the next word.
  const held = words.filter((word) => word.held);
  const band = (word) => ({ type: "rect", xref: "x", yref: "paper", x0: word.s, x1: word.s + Math.max(word.lasted_s, end / 300), y0: 0, y1: 1, fillcolor: faded("warm", 0.3), line: { width: 0 } });
  const turned = words.filter((word, i) => i === 0 || word.phase !== words[i - 1].phase);
  const named = turned.filter((word) => ["takeoff", "landing", "landed", "timeout", "aborted"].includes(word.phase));
  Plotly.react("altitude", [
    { type: "scatter", mode: "lines", name: "its cells", x: [...cells.s, ...(cells.s.length ? [landing(words) ?? end] : [])], y: [...cells.z, ...cells.z.slice(-1)], line: { color: colour("dock"), width: 2, dash: "dot", shape: "hv" }, hovertemplate: "%{y:.0f} m" },
    { type: "scatter", mode: "lines", name: "flown", x: way.s, y: way.z, line: { color: colour("accent"), width: 2 }, hovertemplate: "%{y:.1f} m" },
    { type: "scatter", mode: "markers", name: "held", x: held.map((word) => word.s), y: held.map(() => 0), text: held.map((word) => plain(word.reason)), marker: { symbol: "x", size: 8, color: colour("warm") }, hovertemplate: "%{text}" },
  ], layout({
    shapes: held.map(band), xaxis: seconds({ title: "s" }), yaxis: axis({ range: [0, 1.06 * Math.max(10, ...way.z, ...cells.z)], title: "m", nticks: 5 }),
    annotations: named.map((word, i) => ({ x: word.s, y: 1, xref: "x", yref: "paper", yanchor: "bottom", xanchor: word.s > end / 2 ? "right" : "left", text: plain(word.phase), showarrow: false, yshift: (i % 2) * 13, font: { size: 11, color: colour("muted") } })),
    margin: { l: 8, r: 10, t: 30, b: 8 },
  }), CONFIG);
  if (!document.getElementById("off")) return;
  Plotly.react("off", [{ type: "bar", x: cells.step, y: cells.off_m, marker: { color: colour("accent") }, hovertemplate: "step %{x}: %{y:.2f} m<extra></extra>" }],
    layout({ hovermode: "closest", xaxis: axis({ title: "step", zeroline: false, nticks: 8 }), yaxis: axis({ rangemode: "tozero", title: "m", nticks: 4 }) }), CONFIG);
}

// When it began to come down, seconds; null: it did not.
function landing(words) {
  return words.find((word) => word.phase === "landing")?.s ?? null;
}

// Where it flew up to a step: what is drawn of it in space.
function flownWay(journey, step) {
  const { way, cells } = journey;
  let until = -1;
  cells.step.forEach((one, i) => { if (one <= step) until = cells.s[i]; });
  const last = cells.step.at(-1) === undefined || step >= cells.step.at(-1);
  const n = last ? way.s.length : way.s.filter((s) => s <= until).length;
  return way.s.slice(0, n).map((_, i) => [way.x[i], way.y[i], way.z[i]]);
}
