"use strict";
// Shared by both kinds of page: unpacking, elements, numbers, tables, and the style of figures.
// Text of a bag is set as text, or as `plain` inside a figure, never as markup.

async function unpack(id) {
  const packed = document.getElementById(id).textContent.trim();
  const bytes = Uint8Array.from(atob(packed), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).text();
}

async function loadPlotly() {
  const script = document.createElement("script");
  script.textContent = await unpack("plotly");
  document.head.append(script);
}

function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) element.setAttribute(name, value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

// Plotly reads a few tags in its texts.
const plain = (text) =>
  String(text).replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");

const NONE = "–";
const known = (value) => value !== null && value !== undefined && Number.isFinite(value);

function fixed(value, digits = 0) {
  return known(value) ? value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits }) : NONE;
}

// A number with three significant digits and an SI prefix, such as 346 Mbit.
function si(value, unit) {
  if (!known(value)) return NONE;
  const [scale, prefix] = siScale(Math.abs(value));
  return `${Number((value / scale).toPrecision(3)).toLocaleString("en")} ${prefix}${unit}`;
}

function siScale(value) {
  return [[1e12, "T"], [1e9, "G"], [1e6, "M"], [1e3, "k"]].find(([scale]) => value >= scale) ?? [1, ""];
}

function clock(seconds) {
  const whole = Math.round(seconds);
  const [h, m, s] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
  const two = (n) => String(n).padStart(2, "0");
  return h ? `${h}:${two(m)}:${two(s)}` : `${m}:${two(s)}`;
}

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

function faded(name, alpha) {
  const hex = colour(name).slice(1);
  const [r, g, b] = [0, 2, 4].map((i) => parseInt(hex.slice(i, i + 2), 16));
  return `rgba(${r},${g},${b},${alpha})`;
}

const CONFIG = { displayModeBar: false, responsive: true, scrollZoom: false };

function axis(more = {}) {
  return {
    gridcolor: colour("rule"), zerolinecolor: colour("faint"), linecolor: colour("faint"), automargin: true,
    fixedrange: true, ...more,
    title: more.title ? { text: more.title, font: { size: 12, color: colour("muted") }, standoff: 6 } : undefined,
  };
}

function layout(more = {}) {
  return {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { family: "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", size: 12, color: colour("ink") },
    margin: { l: 8, r: 10, t: 8, b: 8 }, showlegend: false, hovermode: "x unified",
    hoverlabel: { bgcolor: colour("card"), bordercolor: colour("faint"), font: { color: colour("ink") } },
    ...more,
  };
}

// An entry of a legend: a mark, as SVG of our own, and words.
function legendItem(mark, words) {
  const drawn = make("span", { "aria-hidden": "true" });
  drawn.innerHTML = `<svg width="16" height="14">${mark}</svg>`;
  return make("li", {}, drawn, words);
}

const GROUND_DISC = '<circle cx="7" cy="7" r="6.2" fill="var(--ground)" fill-opacity="0.35" stroke="var(--ground)" stroke-width="0.8"/>';

// Entries for what of a world is in the scene: the discs of its clusters, buildings, no-fly zones.
function worldLegend(world, disc) {
  const has = (kind) => world.obstacles.some((one) => one.kind === kind);
  const block = (name, words) => legendItem(`<path d="M2 2h10v10h-10Z" fill="var(--${name})" fill-opacity="0.5" stroke="var(--${name})"/>`, words);
  return [
    world.cluster_radii_m.some((radius_m) => radius_m > 0) ? legendItem(disc, "cluster") : null,
    has("building") ? block("ground", "building") : null,
    has("no_fly") ? block("warm", "no-fly zone") : null,
  ];
}

// A table. A column: {name, text(row), value(row) to sort by, cls, help}.
function table(columns, rows, { caption, sorted = null, label, onmake = () => {} } = {}) {
  const body = make("tbody");
  const lines = rows.map((row) => {
    const line = make("tr", {}, ...columns.map((column) => {
      const content = column.text(row);
      return make("td", { class: column.cls }, content);
    }));
    onmake(line, row);
    return [row, line];
  });
  const heads = columns.map((column) => {
    const head = make("th", { scope: "col", class: column.cls, title: column.help });
    head.append(column.value ? make("button", { type: "button", onclick: () => sort(column, head) }, column.name) : column.name);
    return head;
  });
  function sort(column, head) {
    const down = head.getAttribute("aria-sort") === "ascending";
    heads.forEach((other) => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const order = (a, b) => (typeof a === "string" ? a.localeCompare(b) : a - b);
    lines.sort(([a], [b]) => {
      const [u, v] = [column.value(a), column.value(b)];
      if (u === v) return 0;
      if (u === null || u === undefined) return 1; // unknown values stay at the end
      if (v === null || v === undefined) return -1;
      return down ? order(v, u) : order(u, v);
    });
    body.append(...lines.map(([, line]) => line));
  }
  body.append(...lines.map(([, line]) => line));
  const whole = make("table", {}, caption ? make("caption", {}, caption) : null,
    make("thead", {}, make("tr", {}, ...heads)), body);
  // A part that scrolls must be reachable by the keyboard.
  return make("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": label ?? caption }, whole);
}

function card(title, ...content) {
  return make("div", { class: "card" }, title ? make("h3", {}, title) : null, ...content);
}

function tiles(values) {
  return make("dl", { class: "tiles" }, ...values.map(([name, value, unit, cls]) =>
    make("div", { class: "tile" }, make("dt", {}, name),
      make("dd", { class: cls }, value, unit ? make("small", {}, ` ${unit}`) : ""))));
}

// A circle as a closed line.
function ring([x, y], radius) {
  const turns = Array.from({ length: 49 }, (_, i) => (2 * Math.PI * i) / 48);
  return { x: turns.map((a) => x + radius * Math.cos(a)), y: turns.map((a) => y + radius * Math.sin(a)) };
}

// A figure in space; without WebGL, or on request, a map from above.
const webgl = (() => {
  try { return Boolean(document.createElement("canvas").getContext("webgl")); } catch { return false; }
})();

const space = {
  flat: false,
  // A line or markers: {x, y, z, ...}.
  trace(more) {
    const { z, symbol, ...rest } = more;
    if (!this.flat) return { type: "scatter3d", ...more };
    return { type: "scatter", ...rest };
  },
  // A filled disc at height z.
  disc(points, z, fill) {
    if (this.flat) return { type: "scatter", mode: "lines", ...points, fill: "toself", fillcolor: fill, line: { width: 0 }, hoverinfo: "skip" };
    const n = points.x.length - 1;
    const middle = (values) => values.slice(0, n).reduce((a, b) => a + b, 0) / n;
    const around = Array.from({ length: n }, (_, i) => i);
    return {
      type: "mesh3d", x: [...points.x.slice(0, n), middle(points.x)], y: [...points.y.slice(0, n), middle(points.y)],
      z: Array(n + 1).fill(z), i: around, j: around.map((i) => (i + 1) % n), k: around.map(() => n),
      color: fill, hoverinfo: "skip", lighting: { ambient: 1, diffuse: 0, specular: 0 }, opacity: 1, flatshading: true,
    };
  },
  layout(world, element) {
    const [wide, deep] = [(world.n_x - 1) * world.cell_m, (world.n_y - 1) * world.cell_m];
    // Room for users in reach of a corner.
    const pad = Math.max(0.6 * world.cell_m, Math.min(world.reach_m, 0.22 * Math.max(wide, deep)));
    const range = { x: [-pad, wide + pad], y: [-pad, deep + pad] };
    if (this.flat) {
      return layout({
        hovermode: "closest", dragmode: false,
        xaxis: axis({ title: "east, m", range: range.x, zeroline: false, constrain: "domain" }),
        yaxis: axis({ title: "north, m", range: range.y, zeroline: false, scaleanchor: "x", constrain: "domain" }),
      });
    }
    const side = (title, more) => ({
      title: { text: title, font: { size: 12, color: colour("muted") } }, color: colour("muted"),
      gridcolor: colour("faint"), zerolinecolor: colour("faint"), showbackground: false, showspikes: false, ...more,
    });
    const longest = Math.max(wide, deep) + 2 * pad;
    // A narrow figure is seen from further away and from a steeper angle, to fill its height.
    const narrow = Math.min(1.4, Math.max(1, (1.3 * element.clientHeight) / element.clientWidth));
    const eye = { x: -0.8 * narrow, y: -1.18 * narrow, z: 1.05 * narrow ** 2 };
    return layout({
      margin: { l: 0, r: 0, t: 0, b: 0 }, hovermode: "closest", uirevision: "camera",
      scene: {
        xaxis: side("east, m", { range: range.x }), yaxis: side("north, m", { range: range.y }),
        zaxis: side("altitude, m", { range: [0, 1.15 * world.top_m], nticks: 4 }),
        aspectmode: "manual",
        aspectratio: { x: 1.4 * (wide + 2 * pad) / longest, y: 1.4 * (deep + 2 * pad) / longest, z: 0.42 },
        camera: { eye, center: { x: 0, y: 0, z: -0.16 } },
      },
    });
  },
  // A building or a no-fly zone: its ground plan on the map, its walls and top in 3D.
  obstacle(one) {
    const shade = one.kind === "building" ? "ground" : "warm";
    const common = { hoverinfo: "text", showlegend: false, name: one.kind };
    if (this.flat) {
      const ring = [...one.polygon_m, one.polygon_m[0]];
      return {
        type: "scatter", mode: "lines", x: ring.map((at) => at[0]), y: ring.map((at) => at[1]), fill: "toself", hoveron: "fills",
        fillcolor: faded(shade, one.kind === "building" ? 0.55 : 0.2), line: { color: colour(shade), width: 1.5, dash: one.kind === "building" ? "solid" : "dot" },
        text: plain(one.words), ...common,
      };
    }
    const first = one.x.map((_, i) => i).filter((i) => i % 3 === 0);
    return {
      type: "mesh3d", x: one.x, y: one.y, z: one.z, i: first, j: first.map((i) => i + 1), k: first.map((i) => i + 2),
      color: colour(shade), opacity: one.kind === "building" ? 0.75 : 0.18, flatshading: true, text: one.x.map(() => plain(one.words)), ...common,
    };
  },
  // The world, for both kinds of page.
  world(world) {
    const discs = world.clusters.map((centre, i) => ring(centre, world.cluster_radii_m[i]));
    const join = (of) => discs.flatMap((disc) => [...disc[of], null]);
    return [
      ...discs.map((disc) => this.disc(disc, 0, faded("ground", this.flat ? 0.16 : 0.22))),
      this.trace({
        name: "clusters", mode: "lines", x: join("x"), y: join("y"), z: join("x").map((x) => (x === null ? null : 0)),
        line: { color: colour("ground"), width: 1 }, hoverinfo: "skip",
      }),
      ...world.obstacles.map((one) => this.obstacle(one)),
      this.trace({
        name: "dock", mode: "markers+text", x: [world.dock_m[0]], y: [world.dock_m[1]], z: [0], text: ["dock"],
        textposition: "top center", textfont: { color: colour("ink"), size: 12 }, hoverinfo: "text", hovertext: ["dock"],
        marker: { symbol: "square", size: this.flat ? 15 : 9, color: colour("dock"), line: { color: colour("edge"), width: 1 } },
      }),
      this.trace({
        name: "start", mode: "markers+text", x: [world.start_m[0]], y: [world.start_m[1]], z: [world.start_m[2]],
        text: ["start"], textposition: "bottom center", textfont: { color: colour("ink"), size: 12 }, hoverinfo: "skip",
        marker: { symbol: "circle-open", size: this.flat ? 12 : 7, color: colour("ink"), line: { color: colour("ink"), width: 2 } },
      }),
    ];
  },
};

// Redraw after a change of the colour scheme. Figures resize without it.
function whenColoursChange(draw) {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
}

function viewSwitch(onchange) {
  const buttons = ["3D", "map"].map((name) => make("button", {
    type: "button", "aria-pressed": String((name === "map") === space.flat), disabled: name === "3D" && !webgl,
    title: webgl ? null : "this browser has no WebGL",
    onclick: () => {
      space.flat = name === "map";
      buttons.forEach((button) => button.setAttribute("aria-pressed", String(button.textContent === name)));
      onchange();
    },
  }, name));
  return make("div", { class: "switch", role: "group", "aria-label": "view" }, ...buttons);
}

async function open(build) {
  const page = document.getElementById("page");
  const notice = document.getElementById("notice");
  try {
    if (!("DecompressionStream" in window)) throw new Error("this browser is too old: it needs one of 2023 or later");
    space.flat = !webgl;
    await build(page, JSON.parse(await unpack("data")));
    notice.remove();
    page.removeAttribute("aria-busy");
  } catch (error) {
    notice.textContent = `The page could not be drawn: ${error.message}`;
    throw error;
  }
}
