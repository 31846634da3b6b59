"use strict";
// A line over the steps of a mission, on a canvas, with a cursor; a click moves it.

class Chart {
  constructor(canvas, shade, onclick) {
    Object.assign(this, { canvas, shade, x: [], y: [], top: null, at: null, unit: "", last: 1 });
    canvas.addEventListener("click", (event) => {
      const inside = (event.offsetX - this.left) / (canvas.clientWidth - this.left - 8);
      onclick(Math.round(Math.min(1, Math.max(0, inside)) * this.last));
    });
    new ResizeObserver(() => this.redraw()).observe(canvas);
  }

  // Steps, values (null: not known), the last step of the axis, the step of the cursor.
  draw({ x, y, last, at, top = null, unit = "" }) {
    Object.assign(this, { x, y, at, top, unit, last: Math.max(1, last) });
    this.redraw();
  }

  redraw() {
    if (!this.scheduled) { this.scheduled = true; requestAnimationFrame(() => { this.scheduled = false; this.paint(); }); }
  }

  paint() {
    const { canvas, x, y } = this;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width) return;
    const ratio = Math.min(2, devicePixelRatio || 1);
    canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.font = "11px system-ui, sans-serif";
    const step = niceStep((this.top ?? (Math.max(0, ...y.filter(known)) || 4)) / 3.999);
    const top = this.top ?? step * 4;
    const values = Array.from({ length: 5 }, (_, i) => i * step).filter((value) => value <= top * 1.0001);
    const labels = values.map((value) => `${Number(value.toPrecision(3)).toLocaleString("en")}`);
    this.left = Math.max(...labels.map((text) => pen.measureText(text).width)) + 10;
    const [bottom, ceiling] = [height - 18, 8];
    const px = (value) => this.left + (value / this.last) * (width - this.left - 8);
    const py = (value) => bottom - (value / (top * 1.05)) * (bottom - ceiling);
    pen.strokeStyle = colour("rule"); pen.fillStyle = colour("muted"); pen.lineWidth = 1; pen.textAlign = "right";
    values.forEach((value, i) => {
      pen.beginPath(); pen.moveTo(this.left, py(value)); pen.lineTo(width - 8, py(value)); pen.stroke();
      pen.fillText(labels[i], this.left - 5, py(value) + 4);
    });
    pen.textAlign = "center";
    const each = niceStep(this.last / 6);
    for (let value = 0; value <= this.last; value += Math.max(1, each)) pen.fillText(fixed(value), px(value), height - 4);
    pen.strokeStyle = colour(this.shade); pen.lineWidth = 2; pen.lineJoin = "round";
    pen.beginPath();
    let before = null;
    x.forEach((value, i) => {
      if (!known(y[i])) { before = null; return; }
      if (before === null) pen.moveTo(px(value), py(y[i]));
      else { pen.lineTo(px(value), py(before)); pen.lineTo(px(value), py(y[i])); }
      before = y[i];
    });
    pen.stroke();
    if (known(this.at)) {
      pen.strokeStyle = colour("uav"); pen.lineWidth = 2;
      pen.beginPath(); pen.moveTo(px(this.at), ceiling); pen.lineTo(px(this.at), bottom); pen.stroke();
    }
  }
}
