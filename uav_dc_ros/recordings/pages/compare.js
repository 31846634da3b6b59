// Missions or policies side by side.

// Key, words, unit, digits; with a null for digits: three significant ones, and an SI prefix.
const METRICS = (rewardWords) => [
  ["landed", "landed", "%", 0], ["users_collected", "users collected", "", 1], ["data_bits", "data", "bit", null],
  ["sum_rate_bps", "mean sum-rate", "bit/s", null], ["distance_m", "distance flown", "m", null], ["steps", "steps", "", 1],
  ["reward", `reward ${rewardWords}`, "", 3],
  ["mean_age_s", "age of information", "s", 1], ["fairness", "fairness of data", "", 3], ["last_collected_step", "last user collected at step", "", 1],
  ["energy_used_j", "energy used", "J", null], ["energy_per_mbit_j", "energy for data", "J/Mbit", 1],
];
// Okabe and Ito's colours without yellow, which is invisible on paper. Dashes distinguish groups without colour.
const SHADES = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c7853", "#7f7f9f"];
const DASHES = ["solid", "dash", "dot", "dashdot", "longdash", "longdashdot", "5px,2px", "2px,6px"];

open(async (page, data) => {
  const { groups, world } = data;
  const metrics = METRICS(data.reward_words).filter(([metric]) => groups.some((group) => group.metrics[metric]));
  const hasBattery = groups.some((group) => "state_of_charge" in group.curves);
  const one = groups.every((group) => group.missions === 1);
  const policies = [...new Set(groups.map((group) => group.policy))];
  page.querySelector("header").prepend(make("div", {}, page.querySelector("h1"),
    make("p", { class: "sub" }, policies.length === 1 ? `policy ${policies[0]}` : `policies ${policies.join(", ")}`)));
  const warnings = [
    data.worlds_differ ? "These groups flew in different worlds: their results are not comparable." : "",
    data.rewards_differ ? "These groups have different reward parameters: their rewards are not comparable." : "",
  ].filter(Boolean);
  const key = (i) => {
    const drawn = make("span", { "aria-hidden": "true" });
    const dash = { solid: "", dash: "6 3", dot: "2 3", dashdot: "6 3 2 3", longdash: "9 3", longdashdot: "9 3 2 3" }[DASHES[i]] ?? DASHES[i].replaceAll("px", "").replaceAll(",", " ");
    drawn.innerHTML = `<svg width="30" height="10"><line x1="0" y1="5" x2="30" y2="5" stroke="${SHADES[i]}" stroke-width="3" stroke-dasharray="${dash}"/></svg> `; // our own text only
    return drawn;
  };
  const name = (i) => make("span", {}, key(i), groups[i].label);
  const legend = (...more) => make("ul", { class: "legend" }, ...groups.map((_, i) => make("li", {}, name(i))), ...more);

  // A mean, and below it its interval in the same unit.
  function range(interval, unit, digits, sign = "") {
    if (!interval) return NONE; // a world without a battery, or no data
    const [scale, prefix] = digits === null ? siScale(Math.abs(interval.mean)) : [unit === "%" ? 0.01 : 1, ""];
    const number = (value) => {
      const scaled = Math.abs(value / scale);
      const text = digits === null ? Number(scaled.toPrecision(3)).toLocaleString("en") : fixed(scaled, digits);
      return (value < 0 ? "−" : value > 0 ? sign : "") + text;
    };
    return make("span", {}, `${number(interval.mean)} ${prefix}${unit}`.trim(),
      interval.low === null ? null : make("div", { class: "range" }, `${number(interval.low)} … ${number(interval.high)}`));
  }

  const cell = (...parts) => make("span", {}, ...parts);
  const columns = [
    { name: one ? "mission" : "bag", text: (row) => name(groups.indexOf(row)), value: (row) => row.label },
    ...(policies.length > 1 ? [{ name: "policy", text: (row) => row.policy, value: (row) => row.policy }] : []),
    one ? { name: "seed", text: (row) => row.seeds || NONE, value: (row) => Number(row.seeds) }
      : { name: "missions", text: (row) => cell(String(row.missions), make("div", { class: "range" }, row.seeds && `seed ${row.seeds}`)), value: (row) => row.missions },
  ];
  const figures = metrics.map(([metric, words, unit, digits]) => ({
    name: words, text: (row) => range(row.metrics[metric], unit, digits), value: (row) => row.metrics[metric]?.mean ?? null,
  }));
  const paired = groups.filter((group) => group.paired);
  page.append(
    make("section", { "aria-labelledby": "summary" }, make("h2", { id: "summary" }, "In numbers"),
      make("p", { class: "note" }, one ? "One mission each: figures without intervals." : "Means over the missions, and below them their 95% bootstrap intervals."),
      ...warnings.map((words) => make("p", { class: "warning" }, words)),
      make("div", { class: "grid" }, card(null, table([...columns, ...figures], groups, { label: "Summary" })),
        paired.length ? card(`Difference to ${groups[0].label}, seed by seed`, table([
          { name: "bag", text: (row) => name(groups.indexOf(row)), value: (row) => row.label },
          { name: "seeds in common", text: (row) => String(row.paired.seeds), value: (row) => row.paired.seeds },
          ...metrics.map(([metric, words, unit, digits]) => ({
            name: words, text: (row) => range(row.paired.differences[metric], unit, digits, "+"), value: (row) => row.paired.differences[metric]?.mean ?? null,
          })),
        ], paired, { label: "Paired differences", caption: "Equal seeds give equal users at equal positions. An interval without zero is a significant difference." })) : null)),
    make("section", { "aria-labelledby": "flights" }, make("h2", { id: "flights" }, "Flights"),
      make("div", { class: "grid wide-left" },
        make("div", { class: "card flight" },
          make("div", { class: "card-head" }, make("h3", {}, "Trajectories"), viewSwitch(drawScene)),
          make("div", { class: "scene", id: "scene", role: "img", "aria-label": "Paths of the missions in space" }), legend(...worldLegend(world, GROUND_DISC))),
        make("div", { class: "stack" },
          card("Users collected", make("div", { class: "chart", id: "n_collected" })),
          card("Sum-rate of the users served", make("div", { class: "chart", id: "sum_rate_bps" })),
          card("Reward r^t of each step (eq. 7)", make("div", { class: "chart", id: "reward" })),
          hasBattery ? card("State of charge by the scenario's model", make("div", { class: "chart", id: "state_of_charge" })) : ""))),
    make("footer", {}, `After its end a mission keeps its values, at rate 0. ${one ? "" : "Bands are 95% bootstrap intervals of the mean. "}At most 20 paths of a bag are drawn. World ${world.name} ${world.fingerprint} · made by uav_dc_ros ${data.version}; figures by plotly.js (MIT license). This file needs no network.`));

  function drawScene() {
    Plotly.purge("scene");
    const paths = groups.map((group, i) => {
      const alone = group.paths.length === 1;
      const join = (axis) => group.paths.flatMap((path) => [...path[axis], null]);
      return space.trace({
        name: plain(group.label), mode: "lines", x: join(0), y: join(1), z: join(2), opacity: alone ? 1 : 0.62, hoverinfo: "name",
        line: { color: SHADES[i], width: (space.flat ? 1.6 : 4) * (alone ? 1.5 : 1), dash: DASHES[i] === "solid" ? "solid" : DASHES[i].includes("px") ? "dot" : DASHES[i] },
      });
    });
    Plotly.newPlot("scene", [...space.world(world), ...paths], space.layout(world, document.getElementById("scene")), CONFIG);
  }

  function drawCharts() {
    const chart = (id, title, last, divide = 1) => {
      const traces = groups.flatMap((group, i) => {
        if (!(id in group.curves)) return []; // a world without a battery
        const curve = Object.fromEntries(Object.entries(group.curves[id]).map(([key, values]) => [key, values.map((value) => value / divide)]));
        const edge = { type: "scatter", mode: "lines", x: data.steps, line: { width: 0, shape: "hv" }, hoverinfo: "skip", showlegend: false };
        return [
          ...(group.missions > 1 ? [{ ...edge, y: curve.low }, { ...edge, y: curve.high, fill: "tonexty", fillcolor: `${SHADES[i]}38` }] : []),
          { type: "scatter", mode: "lines", name: plain(group.label), x: data.steps, y: curve.mean, line: { color: SHADES[i], width: 2, dash: DASHES[i], shape: "hv" }, hovertemplate: "%{y:.3~f}" },
        ];
      });
      Plotly.react(id, traces, layout({ xaxis: axis({ zeroline: false, title: last ? `step, ${world.step_s} s each` : "" }), yaxis: axis({ rangemode: "tozero", title, nticks: 5 }) }), CONFIG);
    };
    const [scale, prefix] = siScale(Math.max(1, ...groups.flatMap((group) => group.curves.sum_rate_bps.high)));
    chart("n_collected", "", false);
    chart("sum_rate_bps", `${prefix}bit/s`, false, scale);
    chart("reward", "", !hasBattery);
    if (hasBattery) chart("state_of_charge", "%", true, 0.01);
  }

  function draw() { drawScene(); drawCharts(); }

  await loadPlotly();
  draw();
  whenColoursChange(draw);
});
