// The autopilot's own log: how it fits the bag, its distance from the recorded path, its battery, its events.

function flightLog(log) {
  const ahead = log.ahead_of_gps_s;
  const gps = ahead === null ? "" : ` The bag's clock is ${fixed(Math.abs(ahead), 3)} s ${ahead >= 0 ? "ahead of" : "behind"} GPS.`;
  const hasBattery = log.battery_v.some(known);
  return make("section", { "aria-labelledby": "log-title" },
    make("h2", { id: "log-title" }, "Autopilot's log"),
    make("p", { class: "note" }, `${log.file}, of ${log.autopilot}, aligned by its path: the autopilot started at ${fixed(log.offset_s, 3)} s of the bag. Over ${fixed(log.overlap_s, 1)} s both paths differ by ${fixed(log.rms_m, 2)} m (rms), ${fixed(100 * log.explained, 1)}% of the recorded path is explained.${gps} Times are seconds recorded.`),
    make("div", { class: "grid halves" },
      make("div", { class: "stack" },
        card("Distance of the log's position from the recorded one", make("div", { class: "chart", id: "log-deviation" })),
        hasBattery ? card("Battery", make("div", { class: "chart", id: "log-battery" }),
          make("ul", { class: "legend" }, swatch("accent", "volts"), swatch("warm", "amperes"))) : ""),
      card("Modes, messages and errors", log.events.length ? table([
        { name: "at, s", text: (row) => fixed(row.s, 2), value: (row) => row.s },
        { name: "event", cls: "text", text: (row) => row.text },
      ], log.events, { label: "Events of the log", caption: log.events_total > log.events.length ? `${log.events.length} of ${log.events_total}` : "" })
        : make("p", { class: "note" }, "The log holds none."))));
}

function drawFlightLog(log) {
  const seconds = axis({ title: "seconds recorded", zeroline: false, nticks: 8 });
  const line = (y, shade, unit, more) => ({ type: "scatter", mode: "lines", x: log.s, y, line: { color: colour(shade), width: 2 }, hovertemplate: `%{y} ${unit}<extra></extra>`, ...more });
  Plotly.react("log-deviation", [line(log.deviation_m, "accent", "m")],
    layout({ xaxis: seconds, yaxis: axis({ rangemode: "tozero", title: "m", nticks: 4 }) }), CONFIG);
  if (!document.getElementById("log-battery")) return;
  Plotly.react("log-battery", [line(log.battery_v, "accent", "V"), line(log.battery_a, "warm", "A", { yaxis: "y2" })],
    layout({ xaxis: seconds, yaxis: axis({ title: "V", nticks: 4 }), yaxis2: axis({ title: "A", nticks: 4, tickmode: "auto", overlaying: "y", side: "right", showgrid: false, rangemode: "tozero" }), margin: { l: 8, r: 40, t: 10, b: 8 } }), CONFIG);
}
