// A real vehicle: phases with their reasons, altitude, and distance from its cells.

function vehicle(timeline) {
  const by = (name) => (row) => row[name];
  const { phases, cells } = timeline;
  const left = timeline.phases_total - phases.length;
  return make("section", { "aria-labelledby": "vehicle-title" },
    make("h2", { id: "vehicle-title" }, "Vehicle"),
    make("p", { class: "note" }, "Times are seconds since the first phase report. A step ends when the vehicle reaches its cell, or when the time of the step is over; it may then be far from its cell."),
    make("div", { class: "grid halves" },
      make("div", { class: "stack" },
        card("Altitude", make("div", { class: "chart", id: "altitude", style: "height: 230px" }),
          make("ul", { class: "legend" }, swatch("accent", "flown"), swatch("dock", "its cells"), phases.some((phase) => phase.held) ? swatch("warm", "held by a fault") : null)),
        card("Distance from the centre of the cell", cells.step.length
          ? make("div", { class: "chart", id: "distance" }) : make("p", { class: "note" }, "The vehicle reached no cell."))),
      card("Phases", table([
        { name: "at, s", text: (row) => fixed(row.s, 1), value: by("s") },
        { name: "lasted, s", text: (row) => fixed(row.lasted_s, 1), value: by("lasted_s") },
        { name: "step", text: (row) => String(row.step), value: by("step") },
        { name: "phase", text: by("phase"), value: by("phase"), cls: "phase" },
        { name: "reason", text: (row) => (row.held ? make("b", { class: "bad" }, row.reason) : row.reason || NONE), cls: "text" },
      ], phases, { label: "Phases", caption: left > 0 ? `${phases.length} of ${timeline.phases_total}` : "" }))));
}

function swatch(name, text) {
  return make("li", {}, make("span", { class: "key", style: `background: var(--${name})` }), text);
}

function drawVehicle(timeline) {
  const { phases, path, cells } = timeline;
  const end = Math.max(1, ...path.s, ...phases.map((phase) => phase.s));
  const seconds = (more) => axis({ range: [0, end], zeroline: false, nticks: 8, ...more });
  // A hold lasts until the next phase report.
  const held = phases.filter((phase) => phase.held);
  const band = (phase) => ({ type: "rect", xref: "x", yref: "paper", x0: phase.s, x1: phase.s + Math.max(phase.lasted_s, end / 300), y0: 0, y1: 1, fillcolor: faded("warm", 0.3), line: { width: 0 } });
  const changes = phases.filter((one, i) => i === 0 || one.phase !== phases[i - 1].phase);
  const named = changes.filter((one) => ["takeoff", "landing", "landed", "timeout", "aborted"].includes(one.phase));
  Plotly.react("altitude", [
    { type: "scatter", mode: "lines", name: "its cells", x: [...cells.s, ...(cells.s.length ? [landing(phases) ?? end] : [])], y: [...cells.z, ...cells.z.slice(-1)], line: { color: colour("dock"), width: 2, dash: "dot", shape: "hv" }, hovertemplate: "%{y:.0f} m" },
    { type: "scatter", mode: "lines", name: "flown", x: path.s, y: path.z, line: { color: colour("accent"), width: 2 }, hovertemplate: "%{y:.1f} m" },
    { type: "scatter", mode: "markers", name: "held", x: held.map((phase) => phase.s), y: held.map(() => 0), text: held.map((phase) => plain(phase.reason)), marker: { symbol: "x", size: 8, color: colour("warm") }, hovertemplate: "%{text}" },
  ], layout({
    shapes: held.map(band), xaxis: seconds({ title: "s" }), yaxis: axis({ range: [0, 1.06 * Math.max(10, ...path.z, ...cells.z)], title: "m", nticks: 5 }),
    annotations: named.map((one, i) => ({ x: one.s, y: 1, xref: "x", yref: "paper", yanchor: "bottom", xanchor: one.s > end / 2 ? "right" : "left", text: plain(one.phase), showarrow: false, yshift: (i % 2) * 13, font: { size: 11, color: colour("muted") } })),
    margin: { l: 8, r: 10, t: 30, b: 8 },
  }), CONFIG);
  if (!document.getElementById("distance")) return;
  Plotly.react("distance", [{ type: "bar", x: cells.step, y: cells.distance_m, marker: { color: colour("accent") }, hovertemplate: "step %{x}: %{y:.2f} m<extra></extra>" }],
    layout({ hovermode: "closest", xaxis: axis({ title: "step", zeroline: false, nticks: 8 }), yaxis: axis({ rangemode: "tozero", title: "m", nticks: 4 }) }), CONFIG);
}

// Start of the landing, seconds, or null.
function landing(phases) {
  return phases.find((one) => one.phase === "landing")?.s ?? null;
}

// The path up to a step, as drawn in space.
function flownPath(timeline, step) {
  const { path, cells } = timeline;
  let until = -1;
  cells.step.forEach((one, i) => { if (one <= step) until = cells.s[i]; });
  const last = cells.step.at(-1) === undefined || step >= cells.step.at(-1);
  const n = last ? path.s.length : path.s.filter((s) => s <= until).length;
  return path.s.slice(0, n).map((_, i) => [path.x[i], path.y[i], path.z[i]]);
}
