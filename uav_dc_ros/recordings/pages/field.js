// The page of a scenario: rates with the UAV over each cell, for each layer, and what a check finds.

// Light enough for circles and users to show on every tile.
const RATES = [[0, "#fffde8"], [1 / 3, "#d5eebb"], [2 / 3, "#7cc9bb"], [1, "#2f8fbf"]];

open(async (page, data) => {
  const { world, check } = data;
  const { tour } = check;
  const state = { layer: 0 };
  space.flat = true;
  const top = Math.max(...data.layers.flatMap((layer) => layer.sum_rate_bps.flat()), 1);
  const [scale, prefix] = siScale(top);

  page.querySelector("header > h1").after(make("p", { class: "sub" },
    `${fixed(check.users)} users in ${world.clusters.length} clusters · ${world.n_x} × ${world.n_y} × ${world.n_z} cells of ${fixed(world.cell_m)} m · ${fixed(world.max_steps)} steps of ${world.step_s} s · reach ${fixed(world.d_cons_m)} m · channel ${world.channel}`));
  page.append(
    tiles([
      ["A tour collects", fixed(tour.collected, 1), `of ${fixed(check.users)} users`],
      ["It lands in", String(tour.landed), `of ${tour.missions} missions`, tour.landed < tour.missions ? "bad" : "good"],
      ["It is at the dock by", known(tour.docked_step) ? `step ${fixed(tour.docked_step, 1)}` : NONE, `of ${fixed(world.max_steps)}`],
      ["Without a limit", known(tour.without_limit) ? fixed(tour.without_limit, 1) : NONE, "steps"],
      ["Start to dock", fixed(check.moves_to_dock), "moves"],
      ["A move takes", fixed(check.speed_mps, 1), "m/s"],
      ...(known(tour.energy_used_j) ? [["A mission takes up to", si(tour.energy_used_j, "J"), ""]] : []),
    ]),
    ...check.problems.map((words) => make("p", { class: "warning" }, words)),
    make("section", { "aria-labelledby": "map-title" }, make("h2", { id: "map-title" }, "Map"),
      make("div", { class: "grid wide-left" },
        make("div", { class: "card flight" },
          make("div", { class: "card-head" }, make("h3", { id: "layer" }), layers()),
          make("div", { class: "scene", id: "scene", role: "img", "aria-label": "The field from above, with the sum-rate over each cell" }),
          make("ul", { class: "legend" }, ...legend())),
        make("div", { class: "stack" },
          make("div", { class: "card" }, table([
            { name: "cluster", text: (row) => String(row.index), value: (row) => row.index },
            { name: "centre, m", text: (row) => row.centre_m.map((m) => fixed(m)).join(", ") },
            { name: "in reach", text: (row) => `${fixed(100 * row.in_reach)}%`, value: (row) => row.in_reach, help: "share of its disc within d_cons of a cell" },
            { name: "farthest, m", text: (row) => fixed(row.reach_m), value: (row) => row.reach_m, help: "3D distance from the point of its disc that is farthest from its nearest cell" },
            { name: "collected", text: (row) => `${fixed(row.collected, 1)} of ${row.users}`, value: (row) => row.collected, help: "collected by a tour, mean" },
          ], check.clusters.map((cluster, index) => ({ index, ...cluster })), { label: "Clusters", caption: `What a tour of the clusters collects: means of ${tour.missions} missions` })),
          make("p", { class: "note" }, `Colours: the sum-rate of the users within ${fixed(world.d_cons_m)} m, with the UAV over the cell and nothing collected yet: the mean over the start positions of ${data.missions} missions. Interference and channel are the scenario's.`)))),
    make("footer", {}, `World ${world.name} ${world.fingerprint} · made by uav_dc_ros ${data.version}; figure by plotly.js (MIT license). This file needs no network.`));

  function layers() {
    const buttons = data.layers.map((layer, i) => make("button", {
      type: "button", "aria-pressed": String(i === 0), onclick: () => {
        state.layer = i;
        buttons.forEach((button, j) => button.setAttribute("aria-pressed", String(i === j)));
        draw();
      },
    }, `${fixed(layer.altitude_m)} m`));
    return make("div", { class: "layers", role: "group", "aria-label": "altitude" }, ...buttons);
  }

  function legend() {
    return [
      legendItem('<circle cx="7" cy="7" r="3.4" fill="var(--waiting)"/>', `users at the start of mission 0`),
      legendItem('<circle cx="7" cy="7" r="6" fill="none" stroke="var(--ink)" stroke-dasharray="3 2"/>', "in reach from above the cluster"),
      legendItem('<circle cx="7" cy="7" r="5" fill="var(--card)" stroke="var(--ink)" stroke-width="2"/>', "start"),
      legendItem('<path d="M2 2h10v10h-10Z" fill="var(--dock)"/>', "dock"),
      ...worldLegend(world, '<circle cx="7" cy="7" r="6" fill="none" stroke="var(--ink)"/>'),
      ...(data.out_of_reach_m[0].length ? [legendItem('<path d="M3 3 11 11M11 3 3 11" stroke="var(--bad)" stroke-width="2"/>', "out of reach of every cell")] : []),
    ];
  }

  function draw() {
    const layer = data.layers[state.layer];
    document.getElementById("layer").textContent = `Altitude ${fixed(layer.altitude_m)} m, reaches ${fixed(layer.reach_m)} m on the ground`;
    const join = (rings, of) => rings.flatMap((one) => [...one[of], null]);
    const lines = (name, rings, line) => ({ type: "scatter", mode: "lines", name, x: join(rings, "x"), y: join(rings, "y"), line, hoverinfo: "skip" });
    const dots = (name, [x, y], marker) => ({ type: "scatter", mode: "markers", name, x, y, marker, hoverinfo: "name" });
    const wide = (world.n_x - 1) * world.cell_m;
    const y = -0.5 * world.cell_m - 0.85 * Math.max(world.cell_m, 0.08 * wide); // below the field
    const bar = { x: [wide - data.scale_bar_m, wide], y: [y, y] };
    const ink = "#1d2733"; // on the tiles, which are the same in both schemes
    Plotly.react("scene", [
      { type: "heatmap", name: "rate", x: data.east_m, y: data.north_m, z: layer.sum_rate_bps.map((row) => row.map((rate) => (rate === null ? null : rate / scale))),
        zmin: 0, zmax: top / scale, colorscale: RATES, xgap: 1, ygap: 1, hovertemplate: `%{z:.3~f} ${prefix}bit/s<br>east %{x} m, north %{y} m<extra></extra>`,
        colorbar: { orientation: "h", y: 1, yanchor: "bottom", len: 0.9, thickness: 10, outlinewidth: 0, tickfont: { color: colour("ink") },
          title: { text: `sum-rate, ${prefix}bit/s`, side: "top", font: { size: 12, color: colour("muted") } } } },
      ...world.obstacles.map((one) => space.obstacle(one)),
      lines("clusters", world.clusters.map((centre, i) => ring(centre, world.cluster_radii_m[i])), { color: ink, width: 1.6 }),
      lines("reach", data.hovers_m.map((cell) => ring(cell, layer.reach_m)), { color: ink, width: 1.1, dash: "dash" }),
      dots("users", data.users_m, { symbol: "circle", size: 6, color: colour("waiting"), line: { color: "#ffffff", width: 0.7 } }),
      dots("out of reach", data.out_of_reach_m, { symbol: "x-thin", size: 6, line: { color: colour("bad"), width: 1.5 } }),
      dots("start", [[world.start_m[0]], [world.start_m[1]]], { symbol: "circle", size: 12, color: "#ffffff", line: { color: ink, width: 2.5 } }),
      dots("dock", [[world.dock_m[0]], [world.dock_m[1]]], { symbol: "square", size: 15, color: colour("dock"), line: { color: "#ffffff", width: 1.5 } }),
      lines("scale", [bar], { color: colour("ink"), width: 4 }),
    ], layout({
      hovermode: "closest", dragmode: false, margin: { l: 58, r: 12, t: 8, b: 46 },
      xaxis: axis({ title: "east, m", zeroline: false, showgrid: false, constrain: "domain" }),
      yaxis: axis({ title: "north, m", zeroline: false, showgrid: false, scaleanchor: "x", constrain: "domain", constraintoward: "bottom" }),
      annotations: [{ x: wide - data.scale_bar_m / 2, y, text: `${fixed(data.scale_bar_m, data.scale_bar_m < 1 ? 2 : 0)} m`, showarrow: false, yshift: 11, font: { size: 12, color: colour("ink") } }],
    }), CONFIG);
  }

  await loadPlotly();
  draw();
  whenColoursChange(draw);
});
