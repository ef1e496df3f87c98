// The map canvas: belief tiles, drones, trails and radio links; zoom, pan, fit and follow.
// Map frame: metres, x right, y up. A view is the map point at the canvas centre and pixels per metre.

// readable on dark, and told apart by people with the common colour blindnesses (after Okabe and Ito)
const PALETTE = ["#4cc2ff", "#ffb02e", "#3ddc97", "#ff8bd1", "#f4e04d", "#ff7a45", "#b9a5ff", "#7fe7e0"];
const GREY = "#8b98a5";
const LIMIT = 8;
const MIN_SCALE = 4, MAX_SCALE = 400, FIT_MAX_SCALE = 110;
const FIT_MARGIN = [68, 28, 40, 58]; // left, right, top, bottom: room for the controls, pixels
const TRAIL_LIMIT = 600;
const CLICK_PX = 5;

export const colourOf = (id) => PALETTE[(id - 1 + PALETTE.length * 32) % PALETTE.length];

// [r, g, b, a] of every possible cell, -8 (surely free) to 8 (surely occupied); unknown is see-through
const COLOURS = Array.from({ length: 2 * LIMIT + 1 }, (_, i) => {
  const value = i - LIMIT, share = Math.min(1, Math.abs(value) / 4);
  if (value === 0) return [0, 0, 0, 0];
  const [from, to] = value < 0 ? [[29, 40, 52], [49, 66, 84]] : [[92, 110, 128], [216, 226, 235]];
  return [...from.map((c, k) => Math.round(c + (to[k] - c) * share)), 255];
});

export class MapView {
  constructor(canvas, onMove) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.onMove = onMove;
    this.view = { x: 0, y: 0, scale: 40 };
    this.auto = true;
    this.follow = null;
    this.picked = null; // the cell asked about, by its centre
    this.onPick = null;
    this.reset();
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.listen();
    this.resize();
  }

  reset() {
    this.tiles = new Map();
    this.trails = new Map();
    this.drones = [];
    this.links = [];
    this.raster = null;
    this.bounds = null;
    this.cell = 0.1;
    this.side = 32;
  }

  update(state) {
    this.cell = state.map.cell_m;
    this.side = state.map.tile_cells;
    for (const [column, row, text] of state.map.tiles) this.setTile(column, row, text);
    for (const drone of state.drones) {
      const trail = this.trails.get(drone.id) ?? [];
      trail.push(...drone.trail);
      if (trail.length > TRAIL_LIMIT) trail.splice(0, trail.length - TRAIL_LIMIT);
      this.trails.set(drone.id, trail);
    }
    this.drones = state.drones.filter((d) => d.located);
    this.links = state.links;
    this.draw();
  }

  setTile(column, row, text) {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const n = this.side, image = new ImageData(n, n);
    let top = -1, bottom = n, left = n, right = -1;
    for (let r = 0; r < n; r++) {
      for (let c = 0; c < n; c++) {
        const value = (bytes[r * n + c] << 24) >> 24; // int8
        if (value === 0) continue;
        top = Math.max(top, r); bottom = Math.min(bottom, r); left = Math.min(left, c); right = Math.max(right, c);
        image.data.set(COLOURS[value + LIMIT], ((n - 1 - r) * n + c) * 4); // canvas rows run down, map rows run up
      }
    }
    this.tiles.set(`${column},${row}`, { column, row, image });
    if (right < 0) return;
    const b = this.bounds, x = column * n, y = row * n;
    this.bounds = {
      x0: Math.min(b?.x0 ?? Infinity, x + left), x1: Math.max(b?.x1 ?? -Infinity, x + right + 1),
      y0: Math.min(b?.y0 ?? Infinity, y + bottom), y1: Math.max(b?.y1 ?? -Infinity, y + top + 1),
    };
    this.paint(column, row, image);
  }

  // one canvas holds all tiles, a pixel a cell: drawn scaled in one piece it shows no seams
  paint(column, row, image) {
    const n = this.side, r = this.raster;
    if (!r || column < r.column || row < r.row || column >= r.column + r.columns || row >= r.row + r.rows) {
      const keys = [...this.tiles.values()];
      const low = (f) => Math.min(...keys.map(f)) - 2, high = (f) => Math.max(...keys.map(f)) + 3;
      const c0 = low((t) => t.column), r0 = low((t) => t.row);
      const columns = high((t) => t.column) - c0, rows = high((t) => t.row) - r0;
      const canvas = new OffscreenCanvas(columns * n, rows * n);
      this.raster = { canvas, context: canvas.getContext("2d"), column: c0, row: r0, columns, rows };
      for (const t of keys) this.put(t.column, t.row, t.image);
    } else this.put(column, row, image);
  }

  put(column, row, image) {
    const r = this.raster;
    r.context.putImageData(image, (column - r.column) * this.side, (r.row + r.rows - 1 - row) * this.side);
  }

  // -- view -----------------------------------------------------------------------------------------------------------

  resize() {
    const ratio = window.devicePixelRatio || 1;
    this.width = this.canvas.clientWidth;
    this.height = this.canvas.clientHeight;
    this.canvas.width = Math.max(1, Math.round(this.width * ratio));
    this.canvas.height = Math.max(1, Math.round(this.height * ratio));
    this.ratio = ratio;
    this.draw();
  }

  px(x) { return this.width / 2 + (x - this.view.x) * this.view.scale; }
  py(y) { return this.height / 2 - (y - this.view.y) * this.view.scale; }
  mapPoint(px, py) {
    return [this.view.x + (px - this.width / 2) / this.view.scale, this.view.y - (py - this.height / 2) / this.view.scale];
  }

  fit() {
    let [x0, x1, y0, y1] = [Infinity, -Infinity, Infinity, -Infinity];
    const hold = (x, y) => { x0 = Math.min(x0, x); x1 = Math.max(x1, x); y0 = Math.min(y0, y); y1 = Math.max(y1, y); };
    if (this.bounds) {
      hold(this.bounds.x0 * this.cell, this.bounds.y0 * this.cell);
      hold(this.bounds.x1 * this.cell, this.bounds.y1 * this.cell);
    }
    for (const d of this.drones) { hold(d.x - 0.5, d.y - 0.5); hold(d.x + 0.5, d.y + 0.5); }
    if (x0 > x1) return;
    const [left, right, top, bottom] = FIT_MARGIN;
    const scale = Math.max(MIN_SCALE, Math.min((this.width - left - right) / (x1 - x0), (this.height - top - bottom) / (y1 - y0), FIT_MAX_SCALE));
    this.view = { x: (x0 + x1 + (right - left) / scale) / 2, y: (y0 + y1 + (top - bottom) / scale) / 2, scale };
  }

  setAuto(on) {
    this.auto = on;
    if (on) this.setFollow(null, false);
    this.onMove?.();
    this.draw();
  }

  setFollow(id, draw = true) {
    this.follow = id;
    if (id !== null) { this.auto = false; this.view.scale = Math.max(this.view.scale, 60); }
    this.onMove?.();
    if (draw) this.draw();
  }

  zoom(factor, px = this.width / 2, py = this.height / 2) {
    const [x, y] = this.mapPoint(px, py);
    const scale = Math.min(MAX_SCALE, Math.max(MIN_SCALE, this.view.scale * factor));
    this.view = { scale, x: x - (px - this.width / 2) / scale, y: y + (py - this.height / 2) / scale };
    this.auto = false;
    this.onMove?.();
    this.draw();
  }

  pan(dx, dy) {
    this.view.x -= dx / this.view.scale;
    this.view.y += dy / this.view.scale;
    this.auto = false;
    this.follow = null;
    this.onMove?.();
    this.draw();
  }

  listen() {
    const c = this.canvas;
    let drag = null, dragged = false;
    c.addEventListener("wheel", (e) => { e.preventDefault(); this.zoom(Math.exp(-e.deltaY * 0.0015), e.offsetX, e.offsetY); }, { passive: false });
    c.addEventListener("pointerdown", (e) => { drag = [e.clientX, e.clientY]; dragged = false; c.setPointerCapture(e.pointerId); c.classList.add("dragging"); });
    c.addEventListener("pointermove", (e) => {
      this.cursor = this.mapPoint(e.offsetX, e.offsetY);
      // a finger never lies quite still: what moves less is a click
      if (drag && !dragged && Math.hypot(e.clientX - drag[0], e.clientY - drag[1]) < CLICK_PX) return;
      dragged = Boolean(drag);
      if (drag) { this.pan(e.clientX - drag[0], e.clientY - drag[1]); drag = [e.clientX, e.clientY]; } else this.onMove?.();
    });
    const drop = () => { drag = null; c.classList.remove("dragging"); };
    c.addEventListener("pointerup", (e) => {
      if (drag && !dragged && e.button === 0) this.onPick?.(...this.mapPoint(e.offsetX, e.offsetY));
      drop();
    });
    for (const kind of ["focus", "blur"]) c.addEventListener(kind, () => this.draw());
    c.addEventListener("pointercancel", drop);
    c.addEventListener("pointerleave", () => { this.cursor = null; this.onMove?.(); });
    c.addEventListener("keydown", (e) => {
      const step = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] }[e.key];
      if (step) this.pan(...step);
      else if (e.key === "+" || e.key === "=") this.zoom(1.25);
      else if (e.key === "-") this.zoom(0.8);
      else if (e.key === "Enter" || e.key === " ") this.onPick?.(this.view.x, this.view.y);
      else if (e.key === "f" || e.key === "F") this.setAuto(true);
      else return;
      e.preventDefault();
    });
  }

  // -- drawing --------------------------------------------------------------------------------------------------------

  draw() {
    if (this.queued) return;
    this.queued = true;
    requestAnimationFrame(() => { this.queued = false; this.render(); });
  }

  render() {
    const g = this.context;
    const followed = this.drones.find((d) => d.id === this.follow);
    if (this.auto) this.fit();
    else if (followed) { this.view.x = followed.x; this.view.y = followed.y; }
    g.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    g.clearRect(0, 0, this.width, this.height);
    this.drawGrid(g);
    if (this.raster) {
      const r = this.raster, n = this.side * this.cell;
      g.imageSmoothingEnabled = false;
      g.drawImage(r.canvas, this.px(r.column * n), this.py((r.row + r.rows) * n), r.columns * n * this.view.scale, r.rows * n * this.view.scale);
    }
    for (const d of this.drones) this.drawTrail(g, d);
    this.drawLinks(g);
    for (const d of this.drones) this.drawDrone(g, d);
    this.drawPicked(g);
    this.onMove?.();
  }

  // the cell asked about, and with the keyboard where Enter would ask
  drawPicked(g) {
    g.strokeStyle = "#ffffff";
    g.lineWidth = 2;
    if (this.picked) {
      const size = Math.max(12, this.cell * this.view.scale + 4);
      g.strokeRect(this.px(this.picked[0]) - size / 2, this.py(this.picked[1]) - size / 2, size, size);
    }
    if (!this.canvas.matches(":focus-visible")) return;
    const x = this.px(this.view.x), y = this.py(this.view.y);
    g.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) { g.moveTo(x + 4 * dx, y + 4 * dy); g.lineTo(x + 10 * dx, y + 10 * dy); }
    g.stroke();
  }

  setPicked(at) { this.picked = at; this.draw(); }

  drawGrid(g) {
    const step = [0.5, 1, 2, 5, 10, 20, 50].find((s) => s * this.view.scale >= 24) ?? 100;
    const [x0, y1] = this.mapPoint(0, 0), [x1, y0] = this.mapPoint(this.width, this.height);
    g.lineWidth = 1;
    const line = (i, vertical) => {
      g.strokeStyle = i === 0 ? "#2b3a49" : i % 5 === 0 ? "#1a242e" : "#131b23";
      const at = Math.round(vertical ? this.px(i * step) : this.py(i * step)) + 0.5;
      g.beginPath();
      if (vertical) { g.moveTo(at, 0); g.lineTo(at, this.height); } else { g.moveTo(0, at); g.lineTo(this.width, at); }
      g.stroke();
    };
    for (let i = Math.ceil(x0 / step); i * step <= x1; i++) line(i, true);
    for (let i = Math.ceil(y0 / step); i * step <= y1; i++) line(i, false);
  }

  drawTrail(g, drone) {
    const points = [...(this.trails.get(drone.id) ?? []), [drone.x, drone.y]];
    g.strokeStyle = drone.stale ? GREY : colourOf(drone.id);
    g.lineWidth = 1.75;
    g.lineJoin = "round";
    // four stretches, the older the fainter
    const n = points.length, piece = Math.max(2, Math.ceil(n / 4));
    for (let start = 0, k = 0; start < n - 1; start += piece, k++) {
      g.globalAlpha = 0.3 + 0.55 * Math.min(1, (start + piece) / n);
      g.beginPath();
      points.slice(start, start + piece + 1).forEach(([x, y], i) => (i ? g.lineTo(this.px(x), this.py(y)) : g.moveTo(this.px(x), this.py(y))));
      g.stroke();
    }
    g.globalAlpha = 1;
  }

  drawLinks(g) {
    const at = new Map(this.drones.map((d) => [d.id, d]));
    g.setLineDash([6, 5]);
    g.lineWidth = 1.5;
    g.strokeStyle = "rgba(140, 214, 255, 0.75)";
    for (const [a, b] of this.links) {
      const p = at.get(a), q = at.get(b);
      if (!p || !q) continue;
      g.beginPath();
      g.moveTo(this.px(p.x), this.py(p.y));
      g.lineTo(this.px(q.x), this.py(q.y));
      g.stroke();
    }
    g.setLineDash([]);
  }

  drawDrone(g, d) {
    const x = this.px(d.x), y = this.py(d.y), colour = d.stale ? GREY : colourOf(d.id);
    const size = Math.max(10, Math.min(18, 0.16 * this.view.scale));
    g.save();
    g.translate(x, y);
    g.beginPath();
    g.arc(0, 0, size + 5, 0, 2 * Math.PI);
    g.fillStyle = "rgba(8, 12, 17, 0.55)";
    g.fill();
    if (d.id === this.follow) { g.strokeStyle = "#ffffff"; g.lineWidth = 1.5; g.stroke(); }
    g.rotate(-d.yaw); // canvas angles run clockwise
    g.beginPath();
    g.moveTo(size + 3, 0);
    g.lineTo(-size * 0.75, size * 0.8);
    g.lineTo(-size * 0.4, 0);
    g.lineTo(-size * 0.75, -size * 0.8);
    g.closePath();
    if (d.stale) { g.strokeStyle = "#ff8787"; g.lineWidth = 2; g.stroke(); } // hollow: not by colour alone
    else { g.fillStyle = colour; g.fill(); g.strokeStyle = "#06090d"; g.lineWidth = 1.5; g.stroke(); }
    g.restore();
    this.drawLabel(g, x, y - size - 20, d, colour);
  }

  drawLabel(g, x, y, d, colour) {
    const text = `D${d.id}` + (d.lost ? " lost" : d.stale ? " no data" : d.state === "hold" ? " hold" : d.state === "land" ? " land" : "");
    g.font = "600 12px system-ui, sans-serif";
    g.textBaseline = "middle";
    const width = g.measureText(text).width + 12;
    g.beginPath();
    g.roundRect(x - width / 2, y - 9, width, 18, 4);
    g.fillStyle = d.stale ? "#5c1a1f" : "rgba(8, 12, 17, 0.88)";
    g.fill();
    g.strokeStyle = d.stale ? "#ff6b6b" : colour;
    g.lineWidth = 1;
    g.stroke();
    g.fillStyle = d.stale ? "#ffdada" : colour;
    g.fillText(text, x - width / 2 + 6, y + 0.5);
  }
}
