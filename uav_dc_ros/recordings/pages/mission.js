// The page of one bag: a mission in space and time, its users, and the state of the system.

const STATES = [["waiting", "not collected", "circle"], ["served", "being served", "diamond"], ["collected", "collected", "square"]];
const SIZES = { circle: [4.5, 8], diamond: [7.5, 13], square: [5, 9] }; // in space, on the map
const STEP_MS = 150;

open(async (page, data) => {
  const { world } = data;
  const hasBattery = "battery_j" in world;
  const state = { mission: null, at: 0, chosen: null, timer: null };
  const at = (name) => document.getElementById(name);

  // The skeleton. `show` fills in what depends on the mission.
  const sub = make("p", { class: "sub", id: "about" });
  page.querySelector("header").append(data.shown.length > 1 ? make("label", {}, "Mission ", make("select", {
    id: "missions", "aria-label": "Mission", onchange: (event) => show(event.target.value),
  }, ...data.shown.map((key) => {
    const one = data.missions[key];
    return make("option", { value: key }, `${missionName(one)} · seed ${one.seed ?? "?"} · ${one.outcome} · ${one.users_collected}/${one.users_total}`);
  }))) : "");
  page.querySelector("header > h1").after(sub);
  page.querySelector("header").prepend(make("div", {}, page.querySelector("h1"), sub));

  const play = make("button", { type: "button", class: "play", id: "play", onclick: toggle }, "▶ Play");
  const slider = make("input", { type: "range", id: "step", min: 0, max: 0, value: 0, step: 1, oninput: () => { stop(); go(Number(slider.value)); } });
  const position = make("output", { for: "step", id: "position" });
  const counts = STATES.map(() => make("b", {}, "0"));
  page.append(
    make("div", { id: "tiles" }),
    make("p", { class: "warning", id: "why", hidden: true }),
    make("section", { "aria-labelledby": "flight-title" },
      make("h2", { id: "flight-title" }, "Flight"),
      make("div", { class: "grid wide-left" },
        make("div", { class: "card flight" },
          make("div", { class: "card-head" }, make("h3", {}, "Trajectory"), viewSwitch(drawScene)),
          make("div", { class: "scene", id: "scene", role: "img", "aria-label": "The UAV, its path and the users in space" }),
          make("ul", { class: "legend" }, ...STATES.map(([name, words, shape], i) => make("li", {}, symbol(shape, name), `${words} `, counts[i])),
            make("li", {}, symbol("cross", "uav"), "UAV"), make("li", {}, symbol("square", "dock"), "dock"),
            make("li", {}, symbol("disc", "served"), `within ${fixed(world.d_cons_m)} m of the UAV`),
            ...worldLegend(world, GROUND_DISC))),
        make("div", { class: "stack" },
          card("Users collected", make("div", { class: "chart", id: "collected" })),
          card("Sum-rate of the users served", make("div", { class: "chart", id: "sum-rate" })),
          card("Reward r^t of each step (eq. 7)", make("div", { class: "chart", id: "reward" }),
            make("ul", { class: "legend" }, key("ink", "total"), key("accent", `data: β = ${world.beta} × mean ${world.data_words} / ${si(world.data_scale_bits, "bit")}`),
              key("warm", `trajectory: ζ = ${world.zeta} × R₊ (${world.r_plus})`))),
          hasBattery ? card(`State of charge by the scenario's model, of ${si(world.battery_j, "J")}`, make("div", { class: "chart", id: "charge" })) : "")),
      make("div", { class: "card transport" }, play, make("div", { class: "slide" }, make("label", { for: "step" }, "Step"), slider), position)),
    make("section", { "aria-labelledby": "users-title" },
      make("h2", { id: "users-title" }, "Users"), make("p", { class: "note", id: "users-note" }),
      make("div", { class: "grid wide-right" },
        card("Data of each user over the steps", make("div", { class: "chart tall", id: "data" })),
        make("div", { class: "card", id: "users" }))),
    make("div", { id: "vehicle" }),
    data.log ? flightLog(data.log) : "",
    system(data.health),
    missionList(),
    make("footer", {}, footer()));

  // A listed user has a name; so may a cluster.
  function userName(i) {
    const { user, name } = state.mission.table;
    return name?.[i] ? `${name[i]} (user ${user[i]})` : `user ${user[i]}`;
  }
  function clusterName(index) { return world.cluster_names?.[index] ?? String(index); }

  function missionName(one) { return `mission ${one.mission}` + (one.flight ? ` of flight ${one.flight}` : ""); }

  function symbol(shape, name) {
    const shapes = { circle: '<circle cx="7" cy="7" r="4.2"/>', diamond: '<path d="M7 0.8 13.2 7 7 13.2 0.8 7Z"/>', square: '<path d="M2.5 2.5h9v9h-9Z"/>', cross: '<path d="M5 1h4v4h4v4h-4v4h-4v-4h-4v-4h4Z"/>', disc: '<circle cx="7" cy="7" r="6.2"/>' };
    const drawn = make("span", { "aria-hidden": "true" });
    const faint = shape === "disc" ? 0.35 : 1;
    drawn.innerHTML = `<svg width="14" height="14" fill="var(--${name})" fill-opacity="${faint}" stroke="var(--ink)" stroke-width="0.8">${shapes[shape]}</svg>`; // our own text only
    return drawn;
  }

  function key(name, text) {
    return make("li", {}, make("span", { class: "key", style: `background: var(--${name})` }), text);
  }

  // The figures.

  function steps() { return state.mission.steps; }

  function drawScene() {
    const scene = at("scene");
    Plotly.purge(scene);
    const { timeline } = state.mission;
    const flown = timeline ? flownPath(timeline, Infinity) : steps().map((one) => one.uav_m);
    const column = (i) => flown.map((p) => (p ? p[i] : null));
    const users = STATES.map(([name, words, shape]) => space.trace({
      name: words, mode: "markers", x: [], y: [], z: [], text: [], hovertemplate: "%{text}<extra></extra>",
      marker: { symbol: shape, size: SIZES[shape][Number(space.flat)], color: colour(name), opacity: 1, line: { color: colour(name === "waiting" ? "waiting" : "edge"), width: space.flat ? 1.2 : 1 } },
    }));
    const moving = [
      space.disc(ring([0, 0], 1), 0, faded("served", space.flat ? 0.2 : 0.28)),
      space.trace({ name: "reach", mode: "lines", x: [], y: [], z: [], line: { color: colour("muted"), width: space.flat ? 1.2 : 3, dash: "dash" }, hoverinfo: "skip" }),
      space.trace({ name: "flown", mode: "lines", x: [], y: [], z: [], line: { color: colour("accent"), width: space.flat ? 3 : 7 }, hoverinfo: "skip" }),
      space.trace({ name: "height", mode: "lines", x: [], y: [], z: [], line: { color: colour("uav"), width: space.flat ? 0 : 3 }, hoverinfo: "skip" }),
      ...users,
      space.trace({ name: "chosen", mode: "markers", x: [], y: [], z: [], hoverinfo: "skip", marker: { symbol: "circle-open", size: space.flat ? 20 : 16, color: colour("ink"), line: { color: colour("ink"), width: 3 } } }),
      space.trace({ name: "UAV", mode: "markers", x: [], y: [], z: [], text: [""], hovertemplate: "%{text}<extra></extra>", marker: { symbol: "cross", size: space.flat ? 18 : 13, color: colour("uav"), line: { color: colour("ink"), width: 2 } } }),
    ];
    const still = [
      ...space.world(world),
      ...(timeline ? [space.trace({ name: "cells", mode: "markers", x: timeline.cells.x, y: timeline.cells.y, z: timeline.cells.z, hoverinfo: "skip", marker: { symbol: "square-open", size: space.flat ? 9 : 4, color: colour("dock"), line: { color: colour("dock"), width: 1.5 } } })] : []),
      space.trace({ name: "path", mode: "lines", x: column(0), y: column(1), z: column(2), line: { color: colour("ahead"), width: space.flat ? 1.5 : 2.5 }, hoverinfo: "skip" }),
    ];
    state.moving = moving.map((_, i) => still.length + i);
    Plotly.newPlot(scene, [...still, ...moving], space.layout(world, scene), CONFIG);
    moveScene();
  }

  function moveScene() {
    const now = steps()[state.at];
    const measured = steps().slice(0, state.at + 1).map((one) => one.uav_m).filter(Boolean);
    const here = measured.at(-1);
    const flown = state.mission.timeline ? flownPath(state.mission.timeline, now.step) : measured;
    const users = lastKnown("users_m");
    const foot = ring(here ?? [0, 0], here ? now.reach_m || 0.001 : 0.001);
    const disc = space.flat ? foot : space.disc(foot, 0.4, "");
    const set = [{ ...disc, z: disc.z ?? [] }, { ...foot, z: foot.x.map(() => 0.5) },
      { x: flown.map((p) => p[0]), y: flown.map((p) => p[1]), z: flown.map((p) => p[2]) },
      here ? { x: [here[0], here[0]], y: [here[1], here[1]], z: [0, here[2]] } : { x: [], y: [], z: [] }];
    STATES.forEach(([, words], code) => {
      const these = users ? [...now.state].flatMap((letter, i) => (Number(letter) === code ? [i] : [])) : [];
      counts[code].textContent = [...now.state].filter((letter) => Number(letter) === code).length;
      set.push({
        x: these.map((i) => users[0][i]), y: these.map((i) => users[1][i]), z: these.map(() => 1),
        text: these.map((i) => plain(`${userName(i)}, cluster ${clusterName(state.mission.table.cluster[i])}: ${words}, ${si(lastKnown("data_bits")?.[i], "bit")}`)),
      });
    });
    const i = state.mission.table.user.indexOf(state.chosen);
    set.push(users && i >= 0 ? { x: [users[0][i]], y: [users[1][i]], z: [1] } : { x: [], y: [], z: [] });
    set.push(here ? { x: [here[0]], y: [here[1]], z: [here[2]], text: [`UAV: ${fixed(here[0])} m east, ${fixed(here[1])} m north, ${fixed(here[2])} m high`] } : { x: [], y: [], z: [], text: [] });
    const update = { x: set.map((one) => one.x), y: set.map((one) => one.y), text: set.map((one) => one.text ?? null) };
    if (!space.flat) update.z = set.map((one) => one.z);
    Plotly.restyle("scene", update, state.moving);
  }

  // The latest known value, where a step lacks it.
  function lastKnown(what) {
    for (let i = state.at; i >= 0; i--) if (steps()[i][what] !== null) return steps()[i][what];
    return null;
  }

  const CHARTS = ["collected", "sum-rate", "reward", ...(hasBattery ? ["charge"] : []), "data"];
  const cursor = () => ({ type: "line", xref: "x", yref: "paper", x0: 0, x1: 0, y0: 0, y1: 1, line: { color: colour("uav"), width: 2 } });

  function drawCharts() {
    const x = steps().map((one) => one.step);
    const last = x.at(-1);
    const stepAxis = (more) => axis({ range: [-0.5, last + 0.5], zeroline: false, title: more ?? "", nticks: 8 });
    const line = (name, y, shade, more = {}) => ({
      type: "scatter", mode: x.length > 1 ? "lines" : "markers", x, y, name, line: { color: colour(shade), width: 2, shape: "hv" }, ...more,
    });
    const draw = (id, traces, more) => Plotly.react(id, traces, layout({ shapes: [cursor()], xaxis: stepAxis(), ...more }), CONFIG);
    draw("collected", [line("collected", steps().map((one) => one.n_collected), "collected", { fill: "tozeroy", fillcolor: faded("collected", 0.22), line: { color: colour("accent"), width: 2, shape: "hv" } })],
      { yaxis: axis({ range: [0, world.users * 1.06], nticks: 5 }) });
    const rates = steps().map((one) => one.sum_rate_bps);
    const [rateScale, ratePrefix] = siScale(Math.max(1, ...rates));
    draw("sum-rate", [line("sum-rate", rates.map((rate) => (rate === null ? null : rate / rateScale)), "accent", { hovertemplate: `%{y:.3f} ${ratePrefix}bit/s<extra></extra>`, line: { color: colour("accent"), width: 2, shape: "vh" } })],
      { yaxis: axis({ rangemode: "tozero", title: `${ratePrefix}bit/s`, nticks: 5 }) });
    const reward = (i) => steps().map((one) => one.reward[i]);
    const term = (name, i, shade, more) => line(name, reward(i), shade, { hovertemplate: "%{y:.3f}", line: { color: colour(shade), width: 2, shape: "hv", ...more } });
    draw("reward", [term("data", 0, "accent", { dash: "dash" }), term("trajectory", 1, "warm", { dash: "dot" }), term("total", 2, "ink")],
      { yaxis: axis({ rangemode: "tozero", nticks: 5 }), xaxis: stepAxis(hasBattery ? "" : stepTitle()) });
    if (hasBattery) {
      const charge = steps().map((one) => one.state_of_charge);
      draw("charge", [line("state of charge", charge.map((share) => (share === null ? null : 100 * share)), "warm", {
        customdata: charge.map((share) => (share === null ? NONE : si(share * world.battery_j, "J"))), hovertemplate: "%{y:.1f} %, %{customdata}<extra></extra>",
      })], { yaxis: axis({ range: [0, 106], title: "%", nticks: 5 }), xaxis: stepAxis(stepTitle()) });
    }
    const { user, cluster } = state.mission.table;
    const [dataScale, dataPrefix] = siScale(Math.max(world.r_min_bits, ...user.map((_, i) => state.mission.table.data_bits[i])));
    const data_bits = user.map((_, u) => steps().map((one) => (one.data_bits ? one.data_bits[u] / dataScale : null)));
    const borders = cluster.flatMap((one, i) => (i && one !== cluster[i - 1] ? [i - 0.5] : []));
    draw("data", [{
      type: "heatmap", x, y: user.map((_, i) => i), z: data_bits, zmin: 0, colorscale: "Cividis", hoverongaps: false,
      customdata: user.map((_, i) => x.map(() => [userName(i), clusterName(cluster[i])].map(plain))),
      hovertemplate: `%{customdata[0]}, cluster %{customdata[1]}, step %{x}: %{z:.2f} ${dataPrefix}bit<extra></extra>`,
      colorbar: { title: { text: `${dataPrefix}bit`, font: { size: 12 } }, thickness: 10, outlinewidth: 0, tickcolor: colour("faint"), len: 0.95, tickfont: { color: colour("muted") } },
    }], {
      hovermode: "closest", xaxis: stepAxis(stepTitle()),
      yaxis: axis({ title: "users, by cluster", autorange: "reversed", showgrid: false, zeroline: false,
        tickmode: "array", ...middles(cluster) }),
      shapes: [cursor(), ...borders.map((y) => ({ type: "line", xref: "paper", x0: 0, x1: 1, y0: y, y1: y, line: { color: colour("card"), width: 1.5 } }))],
    });
    for (const id of CHARTS) {
      at(id).removeAllListeners("plotly_click");
      at(id).on("plotly_click", (event) => { stop(); go(nearest(event.points[0].x)); });
    }
  }

  function middles(cluster) {
    const places = new Map();
    cluster.forEach((one, i) => places.set(one, [...(places.get(one) ?? []), i]));
    return { tickvals: [...places.values()].map((rows) => rows[Math.floor(rows.length / 2)]), ticktext: [...places.keys()].map((index) => plain(clusterName(index))) };
  }

  // A step of a real vehicle may end before its time.
  function stepTitle() { return `step, ${state.mission.timeline ? "up to " : ""}${world.step_s} s each`; }

  function secondsAt(step) {
    const { timeline } = state.mission;
    return timeline ? timeline.cells.s[timeline.cells.step.indexOf(step)] ?? 0 : step * world.step_s;
  }

  function nearest(step) {
    let best = 0;
    steps().forEach((one, i) => { if (Math.abs(one.step - step) < Math.abs(steps()[best].step - step)) best = i; });
    return best;
  }

  // Time.

  function go(i) {
    state.at = i;
    const now = steps()[i];
    slider.value = i;
    const words = `step ${now.step} of ${state.summary.steps} · ${clock(secondsAt(now.step))} · ${now.n_collected}/${world.users} collected`;
    position.textContent = words + (now.action ? ` · next: ${now.action}` : "");
    slider.setAttribute("aria-valuetext", words);
    moveScene();
    for (const id of CHARTS) Plotly.relayout(id, { "shapes[0].x0": now.step, "shapes[0].x1": now.step });
  }

  function toggle() {
    if (state.timer !== null) { stop(); return; }
    if (state.at === steps().length - 1) go(0);
    play.textContent = "❚❚ Pause";
    const tick = () => {
      go(state.at + 1);
      if (state.at >= steps().length - 1) stop();
      else state.timer = setTimeout(tick, STEP_MS);
    };
    state.timer = setTimeout(tick, STEP_MS);
  }

  function stop() {
    clearTimeout(state.timer);
    state.timer = null;
    play.textContent = "▶ Play";
  }

  // A mission.

  async function show(key) {
    stop();
    state.mission = JSON.parse(await unpack(`mission-${key}`));
    state.summary = data.missions[key];
    state.chosen = null;
    const one = state.summary;
    document.title = `${data.title} · ${missionName(one)}`;
    sub.replaceChildren(make("b", {}, `${missionName(one)}, seed ${one.seed ?? "unknown"}`), ` · policy ${data.policy} · ${data.vehicle ? `vehicle ${data.vehicle} · ` : ""}bag ${data.bag} · recorded ${data.recorded}`);
    const landed = one.outcome === "landed";
    at("tiles").replaceChildren(tiles([
      ["outcome", `${landed ? "✓" : "✕"} ${one.outcome}`, "", landed ? "good" : "bad"],
      ["users collected", `${one.users_collected}`, `of ${one.users_total}`],
      ["data collected", ...si(one.data_bits, "bit").split(" ")],
      ["mean sum-rate", ...si(one.sum_rate_bps, "bit/s").split(" ")],
      ["distance flown", ...si(one.distance_m, "m").split(" ")],
      ["steps", `${one.steps}`, `of ${world.max_steps}`],
      ...(one.steps_not_reached ? [["steps not reached", `${one.steps_not_reached}`, `of ${one.steps}`, "bad"]] : []),
      [`reward ${world.reward_words}`, fixed(one.reward, 3)],
      ["age of information", one.mean_age_s === null ? NONE : fixed(one.mean_age_s, 1), "s"],
      ["fairness of data", one.fairness === null ? NONE : fixed(one.fairness, 3)],
      ["last user collected", one.last_collected_step === null ? NONE : `step ${one.last_collected_step}`],
      ...("energy_used_j" in one ? [
        ["energy used", ...si(one.energy_used_j, "J").split(" ")],
        ["energy for data", one.energy_per_mbit_j === null ? NONE : fixed(one.energy_per_mbit_j, one.energy_per_mbit_j < 100 ? 1 : 0), "J/Mbit"],
      ] : []),
    ]));
    at("why").hidden = !one.reason || landed;
    at("why").textContent = one.reason ? `${one.outcome}: ${one.reason}` : "";
    at("vehicle").replaceChildren(state.mission.timeline ? vehicle(state.mission.timeline) : "");
    slider.max = steps().length - 1;
    const notes = ["SINR and rate are means over the steps in which a user was served; click a user to find it in the trajectory."];
    if (state.mission.stride > 1) notes.push(`The page shows every ${state.mission.stride}th step; totals are of all steps.`);
    if (state.mission.table.user.length < world.users) notes.push(`The page shows ${state.mission.table.user.length} of ${world.users} users, evenly spaced.`);
    at("users-note").textContent = notes.join(" ");
    at("users").replaceChildren(userTable());
    draw();
    go(steps().length - 1);
  }

  function draw() { drawScene(); drawCharts(); drawSystem(data.health); if (state.mission.timeline) drawVehicle(state.mission.timeline); if (data.log) drawFlightLog(data.log); if (steps().length) go(state.at); }

  function userTable() {
    const columns = state.mission.table;
    const rows = columns.user.map((_, i) => Object.fromEntries(Object.keys(columns).map((name) => [name, columns[name][i]])));
    const by = (name) => (row) => row[name];
    return table([
      { name: "user", text: (row) => String(row.user), value: by("user") },
      ...(columns.name ? [{ name: "name", text: (row) => row.name ?? NONE, value: by("name") }] : []),
      { name: "cluster", text: (row) => (row.name && row.name === clusterName(row.cluster) ? NONE : clusterName(row.cluster)), value: by("cluster") },
      { name: "data", text: (row) => si(row.data_bits, "bit"), value: by("data_bits") },
      { name: "collected at", help: "step", text: (row) => (row.collected_at === null ? NONE : `■ ${row.collected_at}`), value: by("collected_at") },
      { name: "steps served", text: (row) => String(row.served_steps), value: by("served_steps") },
      { name: "SINR, dB", text: (row) => fixed(row.sinr_db, 1), value: by("sinr_db") },
      { name: "rate", text: (row) => si(row.rate_bps, "bit/s"), value: by("rate_bps") },
    ], rows, {
      label: "Table of users",
      onmake: (line, row) => {
        line.dataset.user = row.user;
        const choose = () => {
          state.chosen = state.chosen === row.user ? null : row.user;
          at("users").querySelectorAll("tr").forEach((other) => other.classList.toggle("chosen", other.dataset.user === String(state.chosen)));
          moveScene();
        };
        line.firstChild.replaceChildren(make("button", { type: "button", title: "find it in the trajectory" }, String(row.user)));
        line.addEventListener("click", choose);
      },
    });
  }

  function missionList() {
    if (data.missions.length < 2) return "";
    const left = data.missions_total - data.shown.length;
    const by = (name) => (row) => row[name];
    const shown = new Set(data.shown.map((key) => data.missions[key]));
    return make("section", { "aria-labelledby": "missions-title" }, make("h2", { id: "missions-title" }, "Missions of this bag"),
      left > 0 ? make("p", { class: "note" }, `${data.shown.length} of ${data.missions_total} missions fit into the page; --mission N shows another one.`) : null,
      card(null, table([
        { name: "mission", text: (row) => (shown.has(row) ? make("button", { type: "button", onclick: () => { const key = String(data.missions.indexOf(row)); at("missions").value = key; show(key); scrollTo({ top: 0 }); } }, missionName(row)) : missionName(row)), value: (row) => data.missions.indexOf(row) },
        { name: "seed", text: (row) => String(row.seed ?? NONE), value: by("seed") },
        { name: "outcome", text: by("outcome"), value: by("outcome") },
        { name: "steps", text: (row) => String(row.steps), value: by("steps") },
        { name: "collected", text: (row) => `${row.users_collected}/${row.users_total}`, value: by("users_collected") },
        { name: "data", text: (row) => si(row.data_bits, "bit"), value: by("data_bits") },
        { name: "mean sum-rate", text: (row) => si(row.sum_rate_bps, "bit/s"), value: by("sum_rate_bps") },
        { name: "distance", text: (row) => si(row.distance_m, "m"), value: by("distance_m") },
        { name: `reward ${world.reward_words}`, text: (row) => fixed(row.reward, 3), value: by("reward") },
      ], data.missions, { label: "Missions" })));
  }

  function footer() {
    const about = Object.entries(data.about).map(([name, text]) => `${name} ${text}`).join(" · ");
    return `${about ? `${about} · ` : ""}world ${world.fingerprint} · channel ${world.channel} · made by uav_dc_ros ${data.version}; figures by plotly.js (MIT license). This file needs no network.`;
  }

  await loadPlotly();
  await show(String(data.shown[0]));
  whenColoursChange(draw);
});
