"use strict";
// The live view: receives news of missions, keeps them, and shows them now or at an earlier step.
// Text of messages is set as text, never as markup.

const at = (id) => document.getElementById(id);
const missions = new Map(); // by key
const panels = new Map(); // by namespace
const state = { step: null, scheduled: false }; // step: null means now
window.view = { missions, panels, state }; // for tests and the curious

function take(news) {
  for (const key of [...missions.keys()]) if (!news.keys.includes(key)) missions.delete(key);
  for (const one of news.missions) {
    const mission = missions.get(one.key) ?? { key: one.key, steps: [], events: [], path: [] };
    missions.set(one.key, mission);
    if (one.head) mission.head = one.head;
    mission.now = one.now;
    mission.steps.push(...(one.steps ?? []));
    // The server thins a long mission; so does the page.
    mission.steps = mission.steps.filter((step, i, all) => i === 0 || i === all.length - 1 || step.step % one.stride === 0);
    mission.stride = one.stride;
    mission.events = [...mission.events, ...(one.events ?? [])].slice(-200);
    if (one.path) mission.path = [...mission.path.slice(0, one.path_from), ...one.path];
  }
  schedule();
}

function schedule() {
  if (!state.scheduled) { state.scheduled = true; requestAnimationFrame(() => { state.scheduled = false; show(); }); }
}

const title = (mission) => (mission.head.namespace === "/" ? mission.head.scenario : mission.head.namespace.slice(1));

function show() {
  const byNamespace = new Map();
  for (const one of missions.values()) byNamespace.set(one.head.namespace, [...(byNamespace.get(one.head.namespace) ?? []), one]);
  for (const [namespace, panel] of panels) if (!byNamespace.has(namespace)) { panel.element.remove(); panels.delete(namespace); }
  for (const [namespace, list] of byNamespace) {
    if (!panels.has(namespace)) panels.set(namespace, new Panel(namespace));
    panels.get(namespace).show(list);
  }
  at("empty").hidden = missions.size > 0;
  at("missions").classList.toggle("single", panels.size === 1);
  const last = Math.max(0, ...[...panels.values()].map((panel) => panel.mission?.steps.at(-1)?.step ?? 0));
  at("transport").hidden = !missions.size;
  at("step").max = last;
  if (state.step === null) at("step").value = last;
  at("transport").classList.toggle("past", state.step !== null);
  at("live").setAttribute("aria-pressed", String(state.step === null));
  const shown = state.step ?? last;
  at("position").textContent = state.step === null ? `step ${shown}, now` : `step ${shown} of ${last}`;
  at("step").setAttribute("aria-valuetext", at("position").textContent);
}

function go(step) { state.step = step; if (step !== null) at("step").value = step; schedule(); }

class Panel {
  constructor(namespace) {
    this.namespace = namespace;
    this.chosen = null; // key of a mission; null: the newest
    this.select = make("select", { "aria-label": "Mission", onchange: () => { this.chosen = this.select.selectedIndex === 0 ? null : Number(this.select.value); schedule(); } });
    this.about = make("p", { class: "sub" });
    this.tiles = make("div");
    this.note = make("p", { class: "note" });
    const canvas = make("canvas", { class: "scene3d", role: "img", tabindex: "0", "aria-label": "The UAV, its path and the users in space; arrow keys turn it, plus and minus zoom" });
    this.legend = make("ul", { class: "legend" });
    this.counts = USERS.map(() => make("b", {}, "0"));
    USERS.forEach(([, name, words], i) => this.legend.append(make("li", {}, make("span", { class: "dot", style: `background: var(--${name})` }), words, this.counts[i])));
    const chart = (words, shade) => {
      const line = make("canvas", { class: "line", role: "img", "aria-label": `${words}, over the steps` });
      const heading = make("h3", {}, words);
      return { card: make("div", { class: "card" }, heading, line), heading, chart: new Chart(line, shade, go) };
    };
    this.collected = chart("Users collected", "accent");
    this.rate = chart("Sum-rate", "accent");
    this.battery = chart("Battery, %", "warm");
    this.events = make("div");
    this.element = make("section", { class: "mission", "aria-label": `Mission of ${namespace}` },
      make("div", { class: "wide" }, make("div", { class: "card-head" }, this.heading = make("h2"), this.select), this.about, this.tiles, this.note),
      make("div", { class: "card" }, make("div", { class: "figure" }, canvas, this.looks()), this.legend),
      make("div", { class: "charts" }, this.collected.card, this.rate.card, this.battery.card, this.events));
    at("missions").append(this.element);
    this.scene = new Scene(canvas);
  }

  looks() {
    const buttons = ["3D", "map"].map((name) => make("button", {
      type: "button", "aria-pressed": String(name === "3D"),
      onclick: () => { buttons.forEach((one) => one.setAttribute("aria-pressed", String(one.textContent === name))); this.scene.look(name === "map"); },
    }, name));
    return make("div", { class: "switch", role: "group", "aria-label": "view" }, ...buttons);
  }

  show(list) {
    if (!list.some((one) => one.key === this.chosen)) this.chosen = null;
    const mission = this.mission = list.find((one) => one.key === this.chosen) ?? list.at(-1);
    const { head, now, steps } = mission;
    this.options(list);
    const max = head.world?.max_steps ?? null;
    this.heading.textContent = title(mission);
    this.about.textContent = `${head.scenario} · seed ${head.seed}${head.world ? ` · channel ${head.world.channel}` : ""}`;
    // The last step that is not after the one chosen; live, the newest.
    const past = state.step !== null;
    let i = steps.length - 1;
    while (past && i > 0 && steps[i].step > state.step) i--;
    const step = steps[i] ?? null;
    this.showNumbers(mission, step, past, max);
    this.showScene(mission, i, past);
    this.showCharts(mission, step, max);
    this.showEvents(mission.events);
    const drawn = step ? step.state.length : 0;
    const notes = [
      ...(head.world ? [] : ["This mission's scenario is not one of the shipped ones, nor that of this view: its dock, clusters and obstacles are not drawn."]),
      ...(step && drawn < step.n_users ? [`The page draws ${fixed(drawn)} of ${fixed(step.n_users)} users, evenly spaced.`] : []),
      ...(mission.stride > 1 ? [`The slider reaches every ${mission.stride}th step.`] : []),
    ];
    this.note.textContent = notes.join(" ");
    this.note.hidden = !notes.length;
  }

  options(list) {
    const texts = list.toReversed().map((one, i) => [one.key, `${i ? "" : "newest: "}mission ${one.head.mission}, seed ${one.head.seed}${one.now.over ? `, ${one.now.state}` : ""}`]);
    const key = JSON.stringify(texts);
    this.select.hidden = list.length < 2;
    if (key !== this.listed) {
      this.listed = key;
      this.select.replaceChildren(...texts.map(([value, text]) => make("option", { value }, text)));
    }
    this.select.value = this.chosen ?? list.at(-1).key;
  }

  showNumbers(mission, step, past, max) {
    const now = mission.now;
    const phase = past ? step?.phase ?? NONE : now.state;
    const charge = past ? step?.charge : now.charge;
    const [rate, rateUnit] = step ? si(step.sum_rate_bps, "bit/s").split(" ") : [NONE, ""];
    const bad = past ? phase.includes("(held)") : now.held || now.phase === "aborted";
    this.tiles.replaceChildren(tiles([
      ["phase", phase, "", bad ? "bad" : now.phase === "landed" && !past ? "good" : ""],
      ["step", past ? fixed(step?.step) : fixed(now.step), max ? `of ${max}` : ""],
      ["users collected", step ? fixed(step.n_collected) : NONE, step ? `of ${fixed(step.n_users)}` : ""],
      ["sum-rate", rate, rateUnit],
      ...(known(charge) ? [["battery", fixed(100 * charge), "%"]] : []),
      ...(past ? [["time", clock(step?.s ?? 0)]] : [["steps left", fixed(now.remaining_steps)]]),
    ]));
  }

  showScene(mission, i, past) {
    const { steps, path, now, head } = mission;
    const step = steps[i] ?? null;
    const uav = (past ? step?.uav_m : now.uav_m) ?? null;
    let j = i;
    while (j > 0 && !steps[j].users) j--;
    const from = steps[j] ?? null;
    if (from?.users && typeof from.users === "string") from.users = floats(from.users);
    // The path up to the chosen step is that of the steps; live, it has every point.
    const flown = past ? steps.slice(0, i + 1).map((one) => one.uav_m).filter(Boolean) : [...path, ...(uav ? [uav] : [])];
    this.scene.draw({
      world: head.world, uav, reach: step?.reach_m ?? 0, users: from?.users ?? null,
      state: from === step ? step?.state ?? "" : from.state, path: flown, ahead: past ? path : [],
    });
    USERS.forEach(([code], k) => { this.counts[k].textContent = fixed(step ? step.state.split(code).length - 1 : 0); });
  }

  showCharts({ steps, now }, step, max) {
    const x = steps.map((one) => one.step);
    const base = { x, last: max ?? x.at(-1) ?? 1, at: step?.step ?? null };
    this.collected.chart.draw({ ...base, y: steps.map((one) => one.n_collected), top: steps.at(-1)?.n_users ?? 1 });
    const rates = steps.map((one) => one.sum_rate_bps);
    const [scale, prefix] = siScale(Math.max(1, ...rates));
    this.rate.heading.textContent = `Sum-rate, ${prefix}bit/s`;
    this.rate.chart.draw({ ...base, y: rates.map((rate) => rate / scale) });
    const charge = steps.map((one) => (known(one.charge) ? 100 * one.charge : null));
    this.battery.card.hidden = !known(now.charge) && !charge.some(known);
    this.battery.chart.draw({ ...base, y: charge, top: 100 });
  }

  showEvents(events) {
    const key = `${this.mission.key} ${events.at(-1)?.n}`;
    if (key === this.listedEvents) return;
    this.listedEvents = key;
    this.events.replaceChildren(card("Phases and faults", table([
      { name: "at", text: (row) => clock(row.s) },
      { name: "step", text: (row) => String(row.step) },
      { name: "phase", text: (row) => row.state, cls: "text" },
      { name: "reason", text: (row) => `${row.fault ? `${row.fault}: ` : ""}${row.reason || NONE}`, cls: "text" },
    ], events.toReversed(), { label: "Phases and faults", onmake: (line, row) => {
      if (row.held || row.state === "aborted") line.classList.add("held");
      line.addEventListener("click", () => go(row.step));
    } })));
  }
}

function floats(text) {
  return new Float32Array(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);
}

function link(text, lost = false) {
  at("link").textContent = text;
  at("link").classList.toggle("lost", lost);
}

function connect() {
  const source = new EventSource(`news${location.search}`);
  source.onopen = () => { missions.clear(); link("live"); };
  source.onmessage = (event) => take(JSON.parse(event.data));
  source.addEventListener("end", () => { source.close(); link("The run has ended. This page keeps what it has shown."); });
  source.onerror = () => link("No connection to the mission; trying again.", true);
}

at("step").addEventListener("input", () => go(Number(at("step").value)));
at("live").addEventListener("click", () => go(null));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { for (const panel of panels.values()) panel.listedEvents = null; schedule(); });
connect();
