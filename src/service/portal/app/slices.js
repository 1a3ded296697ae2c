// The grey planes with their contours: one tile of slices.jpg at a time, moved by a slider, pointed into by mouse or keys.
import { h, s } from "./dom.js";
import { number, t } from "./text.js";

const add = (a, b, f) => a.map((x, i) => x + f * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

// The picture of slices.json: resolves once it is decoded.
export function picture(source) {
  return new Promise((resolve, reject) => {
    const image = new Image();
    image.onload = () => resolve(image);
    image.onerror = () => reject(new Error(t("slices.broken")));
    image.src = source;
  });
}

// Pixels of the canvas across, at least.
const FINE = 512;
// Room around the vessel, parts of its extent.
const ROOM = 0.25;

// The square [left, top, columns, rows] of the tiles around all contours; null without any.
function around({ planes, tile }) {
  const points = planes.flatMap((plane) => plane.contours.flat());
  if (points.length === 0) return null;
  const range = (k) => points.reduce(([a, b], p) => [Math.min(a, p[k]), Math.max(b, p[k])], [Infinity, -Infinity]);
  const [x, y] = [range(0), range(1)];
  const side = Math.ceil(Math.min(Math.max((x[1] - x[0]) * (1 + 2 * ROOM), (y[1] - y[0]) * (1 + 2 * ROOM), 24), ...tile));
  const start = ([a, b], n) => Math.round(Math.max(0, Math.min(n - side, (a + b - side) / 2)));
  return [start(x, tile[0]), start(y, tile[1]), side, side];
}

export class Slices {
  // atlas: slices.json; onPlane(k), onPoint(patient point, k).
  constructor(atlas, image, { onPlane = () => {}, onPoint = () => {}, plane, near = false } = {}) {
    Object.assign(this, { atlas, image, onPlane, onPoint });
    const [columns, rows] = atlas.tile;
    const vessel = around(atlas);
    this.k = plane ?? Math.floor(atlas.planes.length / 2);
    this.at = [columns / 2, rows / 2];
    this.marks = [];
    this.circle = null;
    this.canvas = h("canvas", { "aria-hidden": "true" });
    this.overlay = s("svg", { class: "overlay", tabindex: "0", role: "application", "aria-label": t("slices.picture") });
    this.slider = h("input", { type: "range", min: 0, max: atlas.planes.length - 1, step: 1, value: this.k, "aria-label": t(`axis.${atlas.axis}`) });
    this.told = h("output", {});
    this.frame = h("div", { class: "slice-frame" }, this.canvas, this.overlay);
    const zoom = h("input", { type: "checkbox", checked: near && vessel, onchange: () => { this.look(zoom.checked ? vessel : [0, 0, columns, rows]); this.onPlane(this.k); } });
    this.element = h("div", { class: "slices" }, this.frame, h("div", { class: "slice-tools" }, this.slider, this.told),
      vessel ? h("label", { class: "choice" }, zoom, t("slices.near")) : null);
    this.slider.addEventListener("input", () => this.show(Number(this.slider.value), true));
    this.overlay.addEventListener("pointerdown", (e) => this.press(e));
    this.overlay.addEventListener("keydown", (e) => this.keys(e));
    this.look(near && vessel ? vessel : [0, 0, columns, rows]);
  }

  // Shows a part [left, top, columns, rows] of every tile.
  look(part) {
    this.part = part;
    const fine = Math.max(1, Math.round(FINE / part[2]));
    this.canvas.width = part[2] * fine;
    this.canvas.height = part[3] * fine;
    this.overlay.setAttribute("viewBox", `${part[0] - 0.5} ${part[1] - 0.5} ${part[2]} ${part[3]}`);
    this.show(this.k);
  }

  get normal() { return cross(this.atlas.u, this.atlas.v); }
  get origin() { return this.atlas.planes[this.k].origin; }

  toPatient([i, j], k = this.k) {
    const { u, v, pixel_mm: mm, planes } = this.atlas;
    return add(add(planes[k].origin, u, i * mm), v, j * mm);
  }

  // [column, row] of a patient point's foot in the tiles.
  toTile(p) {
    const d = add(p, this.origin, -1);
    return [dot(d, this.atlas.u) / this.atlas.pixel_mm, dot(d, this.atlas.v) / this.atlas.pixel_mm];
  }

  nearest(p) {
    const along = (q) => Math.abs(dot(add(p, q, -1), this.normal));
    const far = this.atlas.planes.map((plane) => along(plane.origin));
    return far.indexOf(Math.min(...far));
  }

  // The part of the tile that is shown, alone, for the plane in 3D.
  tile() {
    const canvas = h("canvas", { width: this.part[2], height: this.part[3] });
    this.paint(canvas, this.k, this.part);
    return canvas;
  }

  paint(canvas, k, [x, y, columns, rows]) {
    const { tile, across } = this.atlas;
    const [left, top] = [(k % across) * tile[0] + x, Math.floor(k / across) * tile[1] + y];
    const context = canvas.getContext("2d");
    context.imageSmoothingQuality = "high";
    context.drawImage(this.image, left, top, columns, rows, 0, 0, canvas.width, canvas.height);
  }

  show(k, told = false) {
    this.k = Math.max(0, Math.min(this.atlas.planes.length - 1, k));
    this.slider.value = this.k;
    const plane = this.atlas.planes[this.k];
    const n = this.normal.map(Math.abs);
    const axis = n.indexOf(Math.max(...n));
    const words = t("slices.place", { axis: t(`axis.${this.atlas.axis}`), index: plane.index, name: "xyz"[axis], mm: number(plane.origin[axis]) });
    this.told.textContent = words;
    this.slider.setAttribute("aria-valuetext", words);
    this.paint(this.canvas, this.k, this.part);
    this.draw();
    if (told) this.onPlane(this.k);
  }

  // Goes to the plane of a patient point and marks it.
  point(p) {
    this.show(this.nearest(p));
    this.at = this.toTile(p);
    this.draw();
  }

  draw() {
    const path = (line) => `M${line.map((p) => p.join(" ")).join("L")}Z`;
    const contours = this.atlas.planes[this.k].contours.map((line) => s("path", { class: "contour", d: path(line) }));
    const [x, y] = this.at;
    const arm = this.part[2] / 40;
    const hair = s("path", { class: "hair", d: `M${x - 3 * arm} ${y}h${2 * arm}M${x + arm} ${y}h${2 * arm}M${x} ${y - 3 * arm}v${2 * arm}M${x} ${y + arm}v${2 * arm}` });
    const seeds = this.marks.filter((p) => this.nearest(p) === this.k).map((p) => {
      const [i, j] = this.toTile(p);
      return s("circle", { class: "seed", cx: i, cy: j, r: arm * 0.8 });
    });
    const ring = this.circle && this.circle.k === this.k ? s("circle", { class: "ring", cx: this.circle.centre[0], cy: this.circle.centre[1], r: this.circle.radius }) : null;
    this.overlay.replaceChildren(...contours, ...seeds, ...(ring ? [ring] : []), hair);
  }

  place(e) {
    const box = this.overlay.getBoundingClientRect();
    const [left, top, columns, rows] = this.part;
    return [left + ((e.clientX - box.left) / box.width) * columns - 0.5, top + ((e.clientY - box.top) / box.height) * rows - 0.5];
  }

  press(e) {
    this.at = this.place(e);
    this.draw();
    if (this.onDrag) {
      this.onDrag(this.at, this.at, false);
      this.overlay.setPointerCapture(e.pointerId);
      const from = this.at;
      const move = (m) => this.onDrag(from, this.place(m), false);
      const end = (m) => {
        this.overlay.removeEventListener("pointermove", move);
        this.onDrag(from, this.place(m), true);
      };
      this.overlay.addEventListener("pointermove", move);
      this.overlay.addEventListener("pointerup", end, { once: true });
      return;
    }
    this.onPoint(this.toPatient(this.at), this.k);
  }

  // Arrows move the crosshair, page keys the plane, Enter points.
  keys(e) {
    const step = e.shiftKey ? 10 : 1;
    const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
    if (moves[e.key]) this.at = [this.at[0] + moves[e.key][0], this.at[1] + moves[e.key][1]];
    else if (e.key === "PageUp") return e.preventDefault(), this.show(this.k + 1, true);
    else if (e.key === "PageDown") return e.preventDefault(), this.show(this.k - 1, true);
    else if (e.key === "Enter") this.onDrag ? this.onDrag(this.at, this.at, true) : this.onPoint(this.toPatient(this.at), this.k);
    else return;
    e.preventDefault();
    this.draw();
  }
}
