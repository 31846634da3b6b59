// The recorded system: latencies, nodes, faults.

function system(health) {
  const ms = (name, digits = 2) => (row) => fixed(row[name], digits);
  const by = (name) => (row) => row[name];
  const latency = [
    { name: "p50, ms", text: ms("p50_ms"), value: by("p50_ms") },
    { name: "p99, ms", text: ms("p99_ms"), value: by("p99_ms") },
    { name: "max, ms", text: ms("max_ms"), value: by("max_ms") },
  ];
  const nodes = health.nodes;
  return make("section", { "aria-labelledby": "system-title" },
    make("h2", { id: "system-title" }, "System"),
    make("p", { class: "note" }, `${clock(health.duration_s)} recorded. A latency is the time from the publication of a message to its receipt by the recorder; 1% of the messages exceed the p99. Times within a step are between two publications.`),
    make("div", { class: "grid halves" },
      card("Latency by topic: p50 to p99, and maximum", make("div", { class: "chart", id: "latency", style: `height: ${70 + 24 * health.topics.length}px` }),
        table([{ name: "within a step", text: by("name") }, { name: "steps", text: (row) => fixed(row.count), value: by("count") }, ...latency], health.chain, { label: "Times within a step" })),
      card("Topics", table([
        { name: "topic", text: by("name"), value: by("name") },
        { name: "messages", text: (row) => fixed(row.count), value: by("count") },
        { name: "rate, Hz", text: (row) => fixed(row.rate_hz, 1), value: by("rate_hz") },
        ...latency,
        { name: "longest gap, ms", text: ms("longest_gap_ms", 1), value: by("longest_gap_ms"), help: "between two messages" },
      ], health.topics, { label: "Topics" }))),
    make("div", { class: "grid" },
      card("Nodes", nodes.length ? table([
        { name: "node", text: by("name"), value: by("name") },
        { name: "last state", text: by("state"), cls: "text" },
        { name: "restarts", text: (row) => row.restarts ?? NONE, value: (row) => Number(row.restarts ?? 0) },
        { name: "warnings", text: (row) => fixed(row.warnings), value: by("warnings") },
        { name: "CPU, %", text: (row) => fixed(row.cpu_median, 0), value: by("cpu_median"), help: "median of the node's process; nodes in one process report the same value" },
        { name: "max", text: (row) => fixed(row.cpu_max, 0), value: by("cpu_max") },
        { name: "until handled: p50 (worst p99), ms", cls: "text", text: (row) => row.latencies.map((one) => `${one.topic} ${fixed(one.p50_ms, 2)} (${fixed(one.p99_ms, 1)})`).join(", ") || NONE },
        { name: "counters", cls: "text", text: (row) => Object.entries(row.counters).map(([name, value]) => `${name} ${value}`).join(", ") || NONE },
      ], nodes, { label: "Nodes" }) : make("p", { class: "note" }, "The bag holds no diagnostics."))),
    ...(health.marks.length ? [make("div", { class: "grid" }, card("Marks", table([
      { name: "at, s", text: (row) => fixed(row.s, 2), value: by("s") },
      { name: "mark", cls: "text", text: by("text") },
    ], health.marks, { label: "Marks" })))] : []),
    make("div", { class: "grid halves" },
      card("CPU of each node's process", nodes.some((node) => node.cpu.length > 1) ? make("div", { class: "chart", id: "cpu", style: "height: 300px" }) : make("p", { class: "note" }, "The recording is too short for a curve: nodes report once a second.")),
      card("Faults", health.faults.length ? table([
        { name: "at, s", text: (row) => fixed(row.s, 2), value: by("s") },
        { name: "source", text: by("source"), value: by("source") },
        { name: "what", cls: "text", text: by("what") },
      ], health.faults, { label: "Faults", caption: health.faults_total > health.faults.length ? `${health.faults.length} of ${health.faults_total}` : "" })
        : make("p", { class: "good", id: "no-faults" }, "✓ None: every step has its messages, no node was restarted, nothing was rejected."))));
}

function drawSystem(health) {
  const rows = health.topics.filter((row) => row.p50_ms !== null).reverse();
  const floor = 1e-3; // for the logarithm; with the clocks of two hosts a latency may be negative
  const at = (value) => Math.max(value, floor);
  const join = (from, to, fill) => rows.flatMap((row) => [fill ?? at(row[from]), fill ?? at(row[to]), null]);
  const names = rows.map((row) => plain(row.name));
  const dots = (name, of, symbol, shade) => ({ type: "scatter", mode: "markers", name, x: rows.map((row) => at(row[of])), y: names, marker: { symbol, size: 9, color: colour(shade), line: { color: colour("card"), width: 1 } }, hovertemplate: `%{y}, ${name}: %{x:.2f} ms<extra></extra>` });
  Plotly.react("latency", [
    { type: "scatter", mode: "lines", x: join("p50_ms", "p99_ms"), y: names.flatMap((name) => [name, name, null]), line: { color: faded("accent", 0.45), width: 6 }, hoverinfo: "skip" },
    dots("median", "p50_ms", "circle", "accent"), dots("99th percentile", "p99_ms", "diamond", "accent"), dots("maximum", "max_ms", "line-ns-open", "warm"),
  ], layout({ hovermode: "closest", xaxis: axis({ type: "log", title: "ms", dtick: 1 }), yaxis: axis({ showgrid: false }) }), CONFIG);
  if (!document.getElementById("cpu")) return;
  const dashes = ["solid", "dash", "dot", "dashdot"];
  const shades = ["accent", "warm", "dock", "uav", "muted", "collected"];
  Plotly.react("cpu", health.nodes.filter((node) => node.cpu.length).map((node, i) => ({
    type: "scatter", mode: "lines", name: plain(node.name), x: node.cpu.map((point) => point[0]), y: node.cpu.map((point) => point[1]),
    line: { color: colour(shades[i % shades.length]), width: 2, dash: dashes[i % dashes.length] }, hovertemplate: "%{y:.0f} %",
  })), layout({ showlegend: true, legend: { orientation: "h", y: -0.22 }, xaxis: axis({ title: "seconds recorded" }), yaxis: axis({ rangemode: "tozero", title: "%" }) }), CONFIG);
}
