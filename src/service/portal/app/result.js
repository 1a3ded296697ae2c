// A result: warnings first, then what the surgeon looks at (3D beside the slices, angles), then curves, tables and files.
// The parts share one focus: a plane, a point, a branch and a distance along it; who moves it tells the others.
import { along } from "./along.js";
import { angleCard, distanceCard, firstShown } from "./angles.js";
import { button, card, field, h, select } from "./dom.js";
import { embedded } from "./embed.js";
import { call, filePath, json, jobPath, lasting } from "./net.js";
import { files } from "./files.js";
import { branchCard, qualityCard } from "./quality.js";
import { rolesPanel } from "./roles.js";
import { mayChange } from "./session.js";
import { picture, Slices } from "./slices.js";
import { countRoles, number, place, t } from "./text.js";
import { scene, surfaceOf } from "./scene.js";
import { varyPanel } from "./vary.js";

// Kinds of warnings that are read without unfolding.
const FIRST = 4;

// One of each kind first, then the rest; a place in the scan is gone to by a press.
export function warnings(list, go) {
  if (!list?.length) return h("p", { class: "card fine" }, t("result.no_warnings"));
  const of = (code) => list.filter((w) => w.code === code);
  const first = [...new Set(list.map((w) => w.code))].slice(0, FIRST).map((code) => of(code)[0]);
  const rest = list.filter((w) => !first.includes(w));
  const item = (w, like = 1) => h("li", {}, h("code", {}, w.code), like > 1 ? h("span", { class: "soft" }, ` ${t("result.like", { n: like })}`) : null,
    ` ${w.message}${place(w.where) ? ` (${place(w.where)})` : ""}`,
    go && w.where?.position ? [" ", button(t("result.go"), async () => go(w.where.position), { class: "quiet small", "aria-label": `${t("result.go")}: ${w.message}` })] : null);
  return h("section", { class: "card warning", "aria-label": t("result.warnings", { n: list.length }) },
    h("h2", {}, t("result.warnings", { n: list.length })),
    h("ul", { class: "warnings" }, first.map((w) => item(w, of(w.code).length))),
    rest.length > 0 ? h("details", {}, h("summary", {}, t("result.more", { n: rest.length })), h("ul", { class: "warnings" }, rest.map((w) => item(w)))) : null);
}

// The junction that the report puts first: measured before others, then that with the widest thinnest branch.
export function mainJunction(found) {
  const width = (j) => Math.min(...(j.branches ?? []).map((id) => found.branches.find((b) => b.id === id)?.diameter_mm ?? 0));
  const measured = (j) => ((j.angles ?? []).some((a) => a.value !== null) ? 1 : 0);
  return [...(found.junctions ?? [])].sort((a, b) => measured(b) - measured(a) || width(b) - width(a) || a.node - b.node)[0];
}

// Who wants to know of the focus; a part does not hear what it said itself.
class Focus {
  constructor() { this.parts = []; }
  join(part, hear) { this.parts.push({ part, hear }); }
  tell(part, what) { for (const each of this.parts) if (each.part !== part) each.hear(what); }
}

export async function showResult(box, job, { signal }) {
  const shell = h("div", { class: "result" }, h("p", { class: "busy", role: "status" }, t("result.reading")));
  box.append(shell);
  const surface = surfaceOf(job.id, signal);
  surface.catch(() => {});
  const [found, list] = await Promise.all([lasting(filePath(job.id, "result.json")), json(`${jobPath(job.id)}/artefacts`, { signal })]);
  if (signal.aborted) return;
  countRoles(found);
  const focus = new Focus();
  const junctions = found.junctions ?? [];
  const shown = { junction: mainJunction(found) };
  const views = h("div", { class: "result-views" });
  const angles = h("div", { class: "stack result-angles" });
  const curves = h("div", { class: "result-curves" });
  const told = (j) => { const a = j.angles?.find((x) => x.value !== null); return t(a ? "result.junction_n" : "result.junction_none", { node: j.node, angle: number(a?.value) }); };
  const here = (j) => j.axes_point ?? j.medial_point;
  const chooser = junctions.length > 1
    ? field(t("result.junction"), select(junctions.map((j) => [String(j.node), told(j)]), String(shown.junction.node), (node) => {
      shown.junction = junctions.find((j) => String(j.node) === node);
      drawAngles();
      if (here(shown.junction)) focus.tell(null, { point: here(shown.junction) });
    }))
    : null;
  const three = scene(views, job, found, { shown, surface, focus, signal });
  const tables = h("div", { class: "stack" }, branchCard(found), qualityCard(found));
  const lines = along(found, focus);
  function drawAngles() {
    const distance = h("div", { class: "contents" });
    const curve = (names) => distance.replaceChildren(...[distanceCard(shown.junction, names)].filter(Boolean));
    angles.replaceChildren(...[chooser, shown.junction ? angleCard(shown.junction, (names) => { three.angles(shown.junction, names); curve(names); }) : card(t("angles.title"), h("p", {}, t("angles.none")))].filter(Boolean));
    if (shown.junction) curve(firstShown(shown.junction));
    else angles.append(tables.firstChild);
    curves.replaceChildren(...[distance, lines].filter(Boolean));
    three.angles(shown.junction, firstShown(shown.junction));
  }
  drawAngles();
  const changes = !mayChange() ? [] : [rolesPanel(job, found, signal), list.items.some((f) => f.name === "sections.json") ? varyPanel(job, found, signal) : null].filter(Boolean);
  shell.replaceChildren(warnings(found.warnings, (point) => { focus.tell(null, { point }); views.scrollIntoView({ block: "nearest" }); }), h("div", { class: "result-top" }, views, angles),
    changes.length > 0 ? h("div", { class: "result-changes" }, changes) : "", curves, h("div", { class: "result-tables" }, tables, embedded ? null : files(list.items)));
  await slicesBeside(views, job, list.items, { focus, three, shown }, signal);
}

// By a call, so that a link's token serves too.
async function pictureOf(path, signal) {
  const address = URL.createObjectURL(await (await call(path, { signal })).blob());
  return picture(address).finally(() => URL.revokeObjectURL(address));
}

async function slicesBeside(views, job, list, { focus, three, shown }, signal) {
  const box = h("div", { class: "pane" }, h("h2", {}, t("slices.title")));
  views.append(box);
  if (!list.some((f) => f.name === "slices.json")) return box.append(h("p", { class: "empty" }, t("slices.none")));
  const [atlas, image] = await Promise.all([lasting(filePath(job.id, "slices.json")), pictureOf(filePath(job.id, "slices.jpg"), signal)]);
  if (signal.aborted) return;
  const part = {};
  const slices = new Slices(atlas, image, {
    onPlane: () => focus.tell(part, { plane: slices }),
    onPoint: (point) => focus.tell(part, { point, plane: slices }),
    near: true,
  });
  focus.join(part, ({ point }) => {
    if (!point) return;
    slices.point(point);
    focus.tell(part, { plane: slices });
  });
  box.append(slices.element, h("p", { class: "soft" }, t("slices.hint")));
  if (shown.junction) slices.point(shown.junction.axes_point ?? shown.junction.medial_point);
  three.slices(slices);
}
