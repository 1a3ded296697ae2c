// The 3D pane of a result: loads the viewer and the surface, holds its tools, and passes on what is asked of it before it
// is there.
import { roleKind } from "./along.js";
import { arcsOf } from "./arcs.js";
import { button, h, select } from "./dom.js";
import { call, filePath } from "./net.js";
import { angleName, number, roleName, t } from "./text.js";
import { vtpArrays } from "./vtp.js";

const VIEWS = ["plane", "front", "left", "head"];
const WALLS = ["clear", "solid", "displacement", "patches", "quality", "none"];
// Smallest angles at the ends of the legend, as walls.js colours them (fetched with three.js, hence not taken from there).
const SHAPES = [30, 60];

// A job's surface, asked for at once: its bytes are on their way while the viewer's code is.
export async function surfaceOf(id, signal) {
  return (await call(filePath(id, "surface.glb"), { signal })).arrayBuffer();
}

// surfaces: [{bytes (a promise of surface.glb), kind?}]; the pane's element and the promise of the viewer.
export function pane(title, surfaces, { found, junction, signal, onPick }) {
  const box = h("div", { class: "scene" }, h("p", { class: "busy" }, t("scene.reading")));
  const legend = h("div", { class: "ramp", hidden: true });
  const tools = h("div", { class: "scene-tools" });
  const element = h("div", { class: "pane" }, h("h2", {}, title), box, legend, tools);
  const viewer = load(box, surfaces, { found, junction, signal, onPick });
  return { element, box, legend, tools, viewer };
}

async function load(box, surfaces, { found, junction, signal, onPick }) {
  // Who waits for the code first must not leave a refusal unheard.
  for (const { bytes } of surfaces) bytes.catch(() => {});
  const view3d = await import("./view3d.js");
  if (!view3d.available) {
    box.replaceChildren(h("p", { class: "empty" }, t("scene.unavailable")));
    return null;
  }
  try {
    const parts = await Promise.all(surfaces.map(async ({ bytes, kind }) => ({ kind, bytes: await bytes })));
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

export function viewButtons(viewer, junction) {
  return h("div", { class: "group", role: "group", "aria-label": t("scene.view") },
    VIEWS.filter((name) => name !== "plane" || junction).map((name) => button(t(`scene.${name}`), async () => (await viewer)?.look(name), { class: "quiet small" })));
}

export function scene(views, job, found, { shown, surface, focus, signal }) {
  const part = {};
  let slices = null;
  const pick = (point) => {
    viewer.then((v) => v?.mark(point));
    focus.tell(part, { point });
  };
  const made = pane(t("scene.title"), [{ bytes: surface }], { found, junction: shown.junction, signal, onPick: pick });
  const { viewer, legend, tools } = made;
  views.append(made.element);
  const check = (key, on, change) => h("label", { class: "choice" }, h("input", { type: "checkbox", checked: on, onchange: (e) => change(e.target.checked) }), t(key));
  const state = { cut: false, plane: true };
  const lay = () => viewer.then((v) => v && slices && v.plane(state.plane || state.cut ? slices : null, state));
  let asked = "clear";
  const wall = select(WALLS.map((w) => [w, t(`wall.${w}`)]), asked, async (mode) => {
    asked = mode;
    try {
      const [v, of] = await Promise.all([viewer, mode === "patches" ? vtpArrays(filePath(job.id, "surface.vtp"), ["FaceId", "PatchId"], signal) : {}]);
      if (!v || asked !== mode) return;
      const there = mode !== "patches" || Boolean(of.PatchId);
      legendOf(legend, mode, there ? v.wall(mode, { ...of, shade: (id) => shadeOf(found, id).name }) : null, found);
    } catch (error) {
      if (error.name !== "AbortError") window.dispatchEvent(new CustomEvent("fault", { detail: error }));
    }
  }, { "aria-label": t("wall.label") });
  tools.append(viewButtons(viewer, shown.junction), wall, check("scene.slice", true, (on) => { state.plane = on; lay(); }), check("scene.cut", false, (on) => { state.cut = on; lay(); }));
  focus.join(part, ({ point, plane }) => {
    if (point) viewer.then((v) => v?.mark(point));
    if (plane) lay();
  });
  return {
    angles: (junction, names) => viewer.then((v) => {
      if (!v) return;
      const arcs = arcsOf(found, junction);
      v.angles(junction, arcs.filter((a) => names.includes(a.name)).map((a) => ({ ...a, title: angleName(a.name), text: `${number(a.value)}°`, note: a.band ? `${number(a.band[0])} – ${number(a.band[1])}` : "" })), sizeOf(found, junction));
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

// A patch is numbered by the end that its branch runs to (PatchId is FaceId of that end's cap less one), not by its branch.
function branchOf(found, id) {
  const end = found.graph.nodes.find((node) => node.cap === id + 1);
  const edge = found.graph.edges.find((e) => end && e.nodes.includes(end.id));
  return found.branches.find((b) => b.id === edge?.branch);
}

// A patch has the colour of its branch's role; where several branches have one role (a tree) each patch has one of its own.
function shadeOf(found, id) {
  const branch = branchOf(found, id);
  const alone = branch && found.branches.every((b) => b.twins < 2) && branch.role !== "other";
  return alone ? { name: branch.role.replace("_", "-"), kind: roleKind(branch) } : { name: `angle-${id % 6}`, kind: `a${id % 6}` };
}

// What the colours mean; told is the viewer's answer, null where it could not colour.
function legendOf(legend, mode, told, found) {
  const value = (text) => h("span", { class: "value" }, text);
  const bar = (kind, label) => h("span", { class: `bar ${kind}`, role: "img", "aria-label": label });
  const parts = {
    displacement: () => { const most = number(told.most, 2); return [t("scene.inward"), value(`≥ ${most} mm`), bar("", t("scene.ramp", { most })), value(`≥ ${most} mm`), t("scene.outward")]; },
    patches: () => told.patches.map((id) => h("span", {}, h("span", { class: `dot ${shadeOf(found, id).kind}`, "aria-hidden": "true" }), roleName(branchOf(found, id) ?? { role: "other", id }))),
    quality: () => [t("scene.shapes"), value(`${SHAPES[0]}°`), bar("back", t("scene.shapes_ramp")), value(`${SHAPES[1]}°`)],
  }[mode];
  legend.replaceChildren(...(told === null ? [t("scene.no_patches")] : (parts?.() ?? [])));
  legend.hidden = !parts;
}
