// The 3D pane of a result: loads the viewer and the surface, holds its tools, and passes on what is asked of it before it
// is there.
import { arcsOf } from "./arcs.js";
import { button, h, select } from "./dom.js";
import { call, filePath } from "./net.js";
import { angleName, number, t } from "./text.js";

const VIEWS = ["plane", "front", "left", "head"];
const WALLS = ["clear", "solid", "displacement", "none"];

// surfaces: [{id, kind?}] of jobs; the pane's element and the promise of the viewer.
export function pane(title, surfaces, { found, junction, signal, onPick }) {
  const box = h("div", { class: "scene" }, h("p", { class: "busy" }, t("scene.reading")));
  const legend = h("div", { class: "ramp", hidden: true });
  const tools = h("div", { class: "scene-tools" });
  const element = h("div", { class: "pane" }, h("h2", {}, title), box, legend, tools);
  const viewer = load(box, surfaces, { found, junction, signal, onPick });
  return { element, box, legend, tools, viewer };
}

async function load(box, surfaces, { found, junction, signal, onPick }) {
  const view3d = await import("./view3d.js");
  if (!view3d.available) {
    box.replaceChildren(h("p", { class: "empty" }, t("scene.unavailable")));
    return null;
  }
  try {
    const read = async ({ id, kind }) => ({ kind, bytes: await (await call(filePath(id, "surface.glb"), { signal })).arrayBuffer() });
    const parts = await Promise.all(surfaces.map(read));
    if (signal.aborted) return null;
    const viewer = await view3d.open(box, parts, { label: t("scene.label"), found, junction, onPick });
    if (signal.aborted) viewer.dispose();
    else signal.addEventListener("abort", () => viewer.dispose(), { once: true });
    return viewer;
  } catch (error) {
    if (error.name !== "AbortError") box.replaceChildren(h("p", { class: "empty" }, t("scene.failed", { why: error.message })));
    return null;
  }
}

export function viewButtons(viewer) {
  return h("div", { class: "group", role: "group", "aria-label": t("scene.view") },
    VIEWS.map((name) => button(t(`scene.${name}`), async () => (await viewer)?.look(name), { class: "quiet small" })));
}

export function scene(views, job, found, shown, focus, signal) {
  const part = {};
  let slices = null;
  const pick = (point) => {
    viewer.then((v) => v?.mark(point));
    focus.tell(part, { point });
  };
  const made = pane(t("scene.title"), [{ id: job.id }], { found, junction: shown.junction, signal, onPick: pick });
  const { viewer, legend, tools } = made;
  views.append(made.element);
  const check = (key, on, change) => h("label", { class: "choice" }, h("input", { type: "checkbox", checked: on, onchange: (e) => change(e.target.checked) }), t(key));
  const state = { cut: false, plane: true };
  const lay = () => viewer.then((v) => v && slices && v.plane(state.plane || state.cut ? slices : null, state));
  const wall = select(WALLS.map((w) => [w, t(`wall.${w}`)]), "clear", (value) => {
    viewer.then((v) => v?.wall(value));
    legend.hidden = value !== "displacement";
  }, { "aria-label": t("wall.label") });
  tools.append(viewButtons(viewer), wall, check("scene.slice", true, (on) => { state.plane = on; lay(); }), check("scene.cut", false, (on) => { state.cut = on; lay(); }));
  ramp(legend, found.surface.displacement_mm);
  focus.join(part, ({ point, plane }) => {
    if (point) viewer.then((v) => v?.mark(point));
    if (plane) lay();
  });
  return {
    angles: (junction, names) => viewer.then((v) => {
      if (!v) return;
      const arcs = arcsOf(found, junction);
      v.angles(arcs.filter((a) => names.includes(a.name)).map((a) => ({ ...a, title: angleName(a.name), text: `${number(a.value)}°`, note: a.band ? `${number(a.band[0])} – ${number(a.band[1])}` : "" })), sizeOf(found, junction));
    }),
    slices: (made) => { slices = made; lay(); },
  };
}

// The graft's diameter sets the size of the arcs.
export function sizeOf(found, junction) {
  const branches = found.branches.filter((b) => (junction?.branches ?? []).includes(b.id));
  const graft = branches.find((b) => b.role === "graft") ?? branches[0];
  return graft?.diameter_mm ?? 5;
}

function ramp(legend, range) {
  if (!range) return;
  const most = Math.max(Math.abs(range.min), Math.abs(range.max));
  legend.append(h("span", {}, t("scene.inward")), h("span", { class: "value" }, `${number(-most, 2)} mm`), h("span", { class: "bar", role: "img", "aria-label": t("scene.ramp", { most: number(most, 2) }) }), h("span", { class: "value" }, `${number(most, 2)} mm`), h("span", {}, t("scene.outward")));
}
