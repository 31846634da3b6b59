"use strict";
// The field in space, on a plain canvas: no WebGL, so that it draws on any machine and leaves its cores to the mission.

const LIGHT = [0.35, -0.5, 0.79];
const TURN = 0.008; // radians for a pixel
const EYE = 3.4; // distance of the eye, in units of the field's size
const ROOM = 34; // pixels on each side
const BACK = { yaw: -0.6, pitch: 0.85, zoom: 1 };
const USERS = [["0", "waiting", "waiting"], ["1", "served", "being served"], ["2", "collected", "collected"]];

// What is drawn: {world, uav, reach, users: Float32Array of all x, then all y, state, path, ghost}.
class Scene {
  constructor(canvas) {
    this.canvas = canvas;
    this.camera = { ...BACK };
    this.drawn = null;
    this.pointers = new Map();
    this.listen();
    new ResizeObserver(() => this.redraw()).observe(canvas);
  }

  listen() {
    const { canvas, pointers } = this;
    canvas.addEventListener("pointerdown", (event) => { pointers.set(event.pointerId, event); canvas.setPointerCapture(event.pointerId); });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const apart = () => { const [a, b] = [...pointers.values()]; return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY); };
      const wide = pointers.size === 2 ? apart() : 0;
      pointers.set(event.pointerId, event);
      if (wide) this.zoom(apart() / wide);
      else this.turn(TURN * (event.clientX - before.clientX), TURN * (event.clientY - before.clientY));
    });
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.zoom(Math.exp(-0.0015 * event.deltaY)); }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const turns = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
      const zoom = { "+": 1.15, "-": 1 / 1.15 }[event.key];
      if (turns) this.turn(...turns); else if (zoom) this.zoom(zoom); else return;
      event.preventDefault();
    });
  }

  turn(yaw, pitch) {
    this.camera.yaw += yaw;
    this.camera.pitch = Math.min(Math.PI / 2, Math.max(0.05, this.camera.pitch + pitch));
    this.redraw();
  }

  zoom(factor) {
    this.camera.zoom = Math.min(12, Math.max(0.4, this.camera.zoom * factor));
    this.redraw();
  }

  look(fromAbove) {
    this.camera = { ...BACK, ...(fromAbove ? { yaw: 0, pitch: Math.PI / 2 } : {}) };
    this.redraw();
  }

  draw(what) { this.drawn = what; this.redraw(); }

  redraw() {
    if (!this.scheduled) { this.scheduled = true; requestAnimationFrame(() => { this.scheduled = false; this.paint(); }); }
  }

  // The projection: metres to pixels, and the distance from the eye, in units of the field's size. The field fills
  // the canvas, with room for the labels.
  fit(bounds, width, height) {
    const { yaw, pitch, zoom } = this.camera;
    const [cx, cy] = [(bounds.x[0] + bounds.x[1]) / 2, (bounds.y[0] + bounds.y[1]) / 2];
    const size = Math.hypot(bounds.x[1] - bounds.x[0], bounds.y[1] - bounds.y[0], bounds.z) / 2 || 1;
    const [sy, cyaw, sp, cp] = [Math.sin(yaw), Math.cos(yaw), Math.sin(pitch), Math.cos(pitch)];
    const project = (x, y, z) => {
      const [dx, dy, dz] = [(x - cx) / size, (y - cy) / size, z / size];
      const [rx, ry] = [cyaw * dx - sy * dy, sy * dx + cyaw * dy];
      const depth = EYE + cp * ry - sp * dz;
      return [rx / depth, -(sp * ry + cp * dz) / depth, depth];
    };
    const corners = bounds.x.flatMap((x) => bounds.y.flatMap((y) => [0, bounds.z].map((z) => project(x, y, z))));
    const range = (i) => [Math.min(...corners.map((one) => one[i])), Math.max(...corners.map((one) => one[i]))];
    const [[left, right], [top, bottom]] = [range(0), range(1)];
    const scale = zoom * Math.min((width - 2 * ROOM) / (right - left), (height - 2 * ROOM) / (bottom - top));
    return (x, y, z) => {
      const [px, py, depth] = project(x, y, z);
      return [width / 2 + scale * (px - (left + right) / 2), height / 2 + scale * (py - (top + bottom) / 2), depth];
    };
  }

  paint() {
    const { canvas, drawn } = this;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!drawn || !width) return;
    const ratio = Math.min(2, devicePixelRatio || 1);
    if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
    if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.lineJoin = "round";
    const bounds = boundsOf(drawn);
    const at = this.fit(bounds, width, height);
    const line = (points, close) => {
      pen.beginPath();
      points.forEach((point, i) => { const [x, y] = at(...point); if (i) pen.lineTo(x, y); else pen.moveTo(x, y); });
      if (close) pen.closePath();
    };
    this.ground(pen, at, line, bounds);
    if (drawn.world) this.world(pen, at, line, drawn.world);
    if (drawn.uav && drawn.reach > 0) {
      line(circle(drawn.uav, drawn.reach), true);
      pen.fillStyle = faded("served", 0.16); pen.fill();
      pen.strokeStyle = faded("warm", 0.8); pen.lineWidth = 1; pen.stroke();
    }
    this.users(pen, at, drawn);
    const solids = drawn.world ? obstacleFaces(drawn.world, at) : [];
    for (const face of solids) {
      pen.beginPath();
      face.points.forEach(([x, y], i) => { if (i) pen.lineTo(x, y); else pen.moveTo(x, y); });
      pen.closePath();
      pen.fillStyle = face.fill; pen.fill();
      pen.strokeStyle = face.edge; pen.lineWidth = 0.6; pen.stroke();
    }
    pen.lineWidth = 1.5; pen.strokeStyle = faded("ahead", 0.9);
    if (drawn.ahead.length > 1) { line(drawn.ahead); pen.stroke(); }
    pen.lineWidth = 2.5; pen.strokeStyle = colour("uav");
    if (drawn.path.length > 1) { line(drawn.path); pen.stroke(); }
    if (drawn.uav) this.uav(pen, at, drawn.uav);
  }

  ground(pen, at, line, bounds) {
    const step = niceStep((bounds.x[1] - bounds.x[0]) / 6);
    const first = ([low]) => Math.ceil(low / step) * step + 0; // no -0
    pen.strokeStyle = colour("faint"); pen.lineWidth = 1; pen.fillStyle = colour("muted"); pen.font = "11px system-ui, sans-serif";
    pen.textAlign = "center";
    for (let x = first(bounds.x); x <= bounds.x[1]; x += step) {
      line([[x, bounds.y[0], 0], [x, bounds.y[1], 0]]); pen.stroke();
      const [px, py] = at(x, bounds.y[0], 0); pen.fillText(fixed(x), px, py + 13);
    }
    pen.textAlign = "right";
    for (let y = first(bounds.y); y <= bounds.y[1]; y += step) {
      line([[bounds.x[0], y, 0], [bounds.x[1], y, 0]]); pen.stroke();
      const [px, py] = at(bounds.x[0], y, 0); pen.fillText(`${fixed(y)} m`, px - 5, py + 4);
    }
  }

  world(pen, at, line, world) {
    world.clusters.forEach((centre, i) => {
      line(circle(centre, Math.max(world.cluster_radii_m[i], 0.05 * world.cell_m)), true);
      pen.fillStyle = faded("ground", 0.2); pen.fill();
      pen.strokeStyle = faded("ground", 0.8); pen.lineWidth = 1; pen.stroke();
    });
    const half = 0.22 * world.cell_m;
    const [x, y] = world.dock_m;
    line([[x - half, y - half, 0], [x + half, y - half, 0], [x + half, y + half, 0], [x - half, y + half, 0]], true);
    pen.fillStyle = colour("dock"); pen.fill();
    pen.fillStyle = colour("ink"); pen.font = "12px system-ui, sans-serif"; pen.textAlign = "center";
    const [px, py] = at(x, y + half, 0);
    pen.fillText("dock", px, py - 5);
  }

  users(pen, at, drawn) {
    const { users, state } = drawn;
    if (!users) return;
    const n = users.length / 2;
    const many = n > 400;
    for (const [code, name] of USERS) {
      pen.fillStyle = colour(name);
      pen.strokeStyle = colour("edge");
      pen.lineWidth = 0.8;
      // Squares for many: a circle takes ten times as long. Served users are larger, so that colour is not all.
      const size = (n > 3000 ? 2 : many ? 3 : 5) * (code === "1" ? 1.5 : 1);
      for (let i = 0; i < n; i++) {
        if (state[i] !== code) continue;
        const [x, y] = at(users[i], users[n + i], 0);
        if (many) pen.fillRect(x - size / 2, y - size / 2, size, size);
        else { pen.beginPath(); pen.arc(x, y, size * 0.8, 0, 2 * Math.PI); pen.fill(); pen.stroke(); }
      }
    }
  }

  uav(pen, at, [x, y, z]) {
    const [top, foot] = [at(x, y, z), at(x, y, 0)];
    pen.strokeStyle = faded("uav", 0.8); pen.lineWidth = 1.5;
    pen.beginPath(); pen.moveTo(top[0], top[1]); pen.lineTo(foot[0], foot[1]); pen.stroke();
    pen.beginPath(); pen.arc(top[0], top[1], 8, 0, 2 * Math.PI);
    pen.fillStyle = colour("uav"); pen.fill();
    pen.strokeStyle = colour("ink"); pen.lineWidth = 2; pen.stroke();
  }
}

function boundsOf({ world, users, uav }) {
  if (world) {
    const [wide, deep] = [(world.n_x - 1) * world.cell_m, (world.n_y - 1) * world.cell_m];
    const pad = 0.5 * world.cell_m;
    return { x: [-pad, wide + pad], y: [-pad, deep + pad], z: world.top_m };
  }
  // An unknown world: as far as its users and the UAV.
  const xs = [...(users ? users.subarray(0, users.length / 2) : []), ...(uav ? [uav[0]] : [])];
  const ys = [...(users ? users.subarray(users.length / 2) : []), ...(uav ? [uav[1]] : [])];
  const range = (values) => values.reduce(([low, high], value) => [Math.min(low, value), Math.max(high, value)], [0, 1]);
  return { x: range(xs), y: range(ys), z: uav ? uav[2] : 1 };
}

function circle([x, y], radius) {
  return Array.from({ length: 40 }, (_, i) => [x + radius * Math.cos((2 * Math.PI * i) / 40), y + radius * Math.sin((2 * Math.PI * i) / 40), 0]);
}

// Triangles of buildings and no-fly zones, the farthest first.
function obstacleFaces(world, at) {
  const faces = [];
  for (const one of world.obstacles) {
    const building = one.kind === "building";
    for (let i = 0; i < one.x.length; i += 3) {
      const corners = [0, 1, 2].map((j) => [one.x[i + j], one.y[i + j], one.z[i + j]]);
      const points = corners.map((corner) => at(...corner));
      const bright = building ? 0.55 + 0.45 * Math.abs(facing(corners)) : 1;
      faces.push({
        points, depth: points[0][2] + points[1][2] + points[2][2],
        fill: building ? shaded("ground", bright) : faded("warm", 0.14), edge: building ? shaded("ground", 0.9 * bright) : faded("warm", 0.25),
      });
    }
  }
  return faces.sort((a, b) => b.depth - a.depth);
}

function facing([a, b, c]) {
  const [u, v] = [b.map((value, i) => value - a[i]), c.map((value, i) => value - a[i])];
  const normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
  const length = Math.hypot(...normal) || 1;
  return normal.reduce((sum, value, i) => sum + value * LIGHT[i], 0) / length;
}

function shaded(name, bright) {
  const hex = colour(name).slice(1);
  return `rgba(${[0, 2, 4].map((i) => Math.round(parseInt(hex.slice(i, i + 2), 16) * bright)).join(",")},0.88)`;
}

// One, two or five times a power of ten, at least as large as a value.
function niceStep(value) {
  const power = 10 ** Math.floor(Math.log10(Math.max(value, 1e-9)));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= value);
}
