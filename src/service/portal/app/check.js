// What the service understood of a scan that has arrived, before it is reconstructed: picture, geometry, vessels found,
// warnings; and the plan: geometry of plain images, seeds or a circle on a slice, priority, anything else as JSON.
import { announce, button, field, h, select } from "./dom.js";
import { problemBox } from "./faults.js";
import { Fault } from "./net.js";
import { picture, Slices } from "./slices.js";
import { number, place, t } from "./text.js";

const GEOMETRY_CODES = ["input.geometry_missing", "input.geometry"];

export function check(box, transfer, signal) {
  const found = h("div", { class: "understood" });
  const plan = h("div", { class: "stack" });
  const panel = { box, transfer, signal, found, plan };
  const send = button(t("send.reconstruct"), async () => {
    const job = await transfer.submit();
    transfer.job = job.id;
    transfer.change({});
    location.hash = `#/jobs/${job.id}`;
  }, { id: `reconstruct-${transfer.number}` });
  box.replaceChildren(found, h("div", { class: "actions end" }, send));
  panel.send = send;
  look(panel);
}

// Asks the service and draws its answer.
async function look(panel) {
  const { transfer, found, signal } = panel;
  if (transfer.job) return done(panel);
  found.replaceChildren(h("p", { class: "busy", role: "status" }, t("check.reading")));
  const asked = JSON.stringify(transfer.plan);
  // Who comes back to this view sees the answer of before.
  let answer = transfer.checked?.plan === asked ? transfer.checked.answer : null;
  try {
    answer ??= await transfer.submit({ validate: true, signal });
    transfer.understood = answer.understood;
    transfer.checked = { plan: asked, answer };
  } catch (error) {
    if (!(error instanceof Fault)) return;
    transfer.understood = null;
    found.replaceChildren(problemBox(error.problem, t("check.refused")), panel.plan);
    drawPlan(panel, error.problem);
    return;
  }
  const told = answer.understood;
  announce(t("check.done"));
  if (!told) return found.replaceChildren(h("p", {}, t("check.nothing")), panel.plan);
  panel.slices = null;
  panel.refused = told.refusal;
  const refusal = told.refusal && told.refusal.code !== transfer.known ? problemBox(told.refusal, t("check.no_vessel")) : null;
  const warnings = (told.warnings ?? []).map((w) => h("li", {}, h("code", {}, w.code), ` ${w.message}${place(w.where) ? ` (${place(w.where)})` : ""}`));
  const view = h("div", { class: "check-picture" });
  // Beside the picture, so that a tool and what it is used on are seen together.
  found.replaceChildren(...[refusal, h("div", { class: "check-grid" }, view,
    h("div", {}, h("h3", {}, t("check.title")), facts(told),
      warnings.length > 0 ? [h("h3", {}, t("check.warnings")), h("ul", { class: "warnings" }, warnings)] : null, panel.plan))].filter(Boolean));
  if (told.slices) {
    const image = await picture(told.slices.image);
    panel.slices = new Slices(told.slices, image, { plane: panel.plane });
    panel.slices.spacing = [told.input.spacing_mm[1], told.input.spacing_mm[0]];
    view.append(panel.slices.element);
  }
  drawPlan(panel, null);
}

function done({ box, transfer }) {
  box.replaceChildren(h("p", {}, t("send.done"), " ", h("a", { href: `#/jobs/${transfer.job}` }, t("send.open"))));
}

function facts({ input, segmentation }) {
  const [row, column, slice] = input.spacing_mm;
  const normal = orientation(input);
  const lumens = Math.max(0, ...(segmentation?.lumens ?? []).map((l) => l.count));
  const rows = [
    ["check.format", t(`format.${input.format}`)],
    ["check.size", `${input.columns} × ${input.rows} × ${input.slices}`],
    ["check.spacing", `${number(row, 3)} × ${number(column, 3)} × ${number(slice, 3)} mm`],
    ["check.orientation", normal],
    ["check.missing", input.missing_slices.length === 0 ? t("word.none") : input.missing_slices.join(", ")],
    ["check.contours", segmentation ? t("check.contours_found", { n: segmentation.contours, lumens, axis: t(`axis.${segmentation.axis}`) }) : "–"],
  ];
  return h("dl", { class: "facts" }, rows.map(([key, value]) => [h("dt", {}, t(key)), h("dd", {}, value)]));
}

// The plane that the slices lie in, by their normal.
function orientation({ row_direction: u, column_direction: v }) {
  const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]].map(Math.abs);
  const k = n.indexOf(Math.max(...n));
  const name = t(`plane.${["sagittal", "coronal", "axial"][k]}`);
  return n[k] > 0.999 ? name : t("plane.oblique", { name, angle: number((Math.acos(Math.min(1, n[k])) * 180) / Math.PI) });
}

// The plan's forms. What they change is checked again.
function drawPlan(panel, problem) {
  const { transfer, plan, slices } = panel;
  const again = () => { panel.plane = slices?.k; look(panel); };
  const wantsGeometry = problem && (GEOMETRY_CODES.includes(problem.code) || (problem.errors ?? []).some((e) => GEOMETRY_CODES.includes(e.code)));
  const pictures = transfer.understood?.input.format === "pictures";
  const text = more(transfer, again);
  plan.replaceChildren(...[
    wantsGeometry || pictures ? geometryForm(transfer, again, Boolean(wantsGeometry)) : null,
    slices ? placing(panel, again, text.show) : null,
    text.element,
  ].filter(Boolean));
  panel.send.hidden = Boolean(problem);
}

function fold(title, open, ...children) {
  return h("details", { open }, h("summary", {}, title), children);
}

function geometryForm(transfer, again, open) {
  const known = transfer.plan.geometry ?? {};
  const input = (value) => h("input", { type: "number", min: "0.001", step: "any", required: true, value: value ?? "" });
  const [row, column, slice] = [input(known.pixel_spacing_mm?.[0]), input(known.pixel_spacing_mm?.[1]), input(known.slice_spacing_mm)];
  return fold(t("geometry.title"), open, h("form", {
    class: "fields", onsubmit: (e) => {
      e.preventDefault();
      transfer.plan.geometry = { ...known, pixel_spacing_mm: [Number(row.value), Number(column.value)], slice_spacing_mm: Number(slice.value) };
      again();
    },
  }, h("p", { class: "soft" }, t("geometry.why")),
  field(t("geometry.row"), row), field(t("geometry.column"), column), field(t("geometry.slice"), slice),
  h("button", { type: "submit", class: "quiet" }, t("check.again"))));
}

// Seeds and the circle, placed on the picture.
function placing(panel, again, told) {
  const { transfer, slices } = panel;
  const segmentation = () => (transfer.plan.segmentation ??= {});
  const list = h("p", { class: "soft" });
  const draw = () => {
    const { seeds_mm: seeds = [], region } = transfer.plan.segmentation ?? {};
    slices.marks = seeds;
    slices.circle = region ? ringOf(slices, region) : null;
    slices.draw();
    told();
    list.textContent = [seeds.length > 0 ? t("placing.seeds", { n: seeds.length }) : "", region ? t("placing.region", { slice: region.slice, radius: number(region.radius_px) }) : ""].filter(Boolean).join(" · ") || t("placing.nothing");
  };
  const tools = { look: null, seed: (from, _to, end) => end && (segmentation().seeds_mm = [...(segmentation().seeds_mm ?? []), slices.toPatient(from).map((x) => Number(x.toFixed(2)))], draw()), circle: (from, to) => { segmentation().region = regionOf(slices, from, to); draw(); } };
  const choose = (name) => { slices.onDrag = tools[name]; slices.element.dataset.tool = name; };
  const radios = Object.keys(tools).map((name, i) => h("label", { class: "choice" },
    h("input", { type: "radio", name: `tool-${transfer.number}`, value: name, checked: i === 0, onchange: () => choose(name) }), t(`placing.${name}`)));
  draw();
  return fold(t("placing.title"), Boolean(transfer.plan.segmentation ?? panel.refused), h("p", { class: "soft" }, t("placing.why")),
    h("div", { class: "choices", role: "radiogroup", "aria-label": t("placing.title") }, radios), list,
    h("div", { class: "actions" },
      h("button", { type: "button", class: "quiet", onclick: again }, t("check.again")),
      h("button", { type: "button", class: "quiet", onclick: () => { delete transfer.plan.segmentation; again(); } }, t("placing.clear"))));
}

// Tile pixels and those of the slice itself: the picture may be cropped and coarser.
const toSlice = (slices, p) => p.map((x, i) => (x * slices.atlas.pixel_mm + slices.atlas.offset_mm[i]) / slices.spacing[i]);
const toTile = (slices, p) => p.map((x, i) => (x * slices.spacing[i] - slices.atlas.offset_mm[i]) / slices.atlas.pixel_mm);

function regionOf(slices, from, to) {
  const round = (x) => Number(x.toFixed(1));
  const radius = (Math.max(2, Math.hypot(to[0] - from[0], to[1] - from[1])) * slices.atlas.pixel_mm) / slices.spacing[0];
  return { slice: slices.atlas.planes[slices.k].index, centre_px: toSlice(slices, from).map(round), radius_px: round(radius) };
}

function ringOf(slices, region) {
  const k = slices.atlas.planes.findIndex((p) => p.index === region.slice);
  return { k, centre: toTile(slices, region.centre_px), radius: (region.radius_px * slices.spacing[0]) / slices.atlas.pixel_mm };
}

// JSON with a line for each field; lists of numbers stay on one.
const written = (plan) => JSON.stringify(plan, null, 1).replace(/\[\s+([^[\]{}]*?)\s+\]/g, (_, list) => `[${list.replace(/\s+/g, " ")}]`);

function more(transfer, again) {
  const text = h("textarea", { rows: 6, spellcheck: "false" });
  // What the forms set is written here at once: it would be lost with the text's own check otherwise.
  const show = () => { text.value = written(transfer.plan); };
  show();
  const fault = h("p", { class: "bad", role: "alert" });
  const apply = () => {
    try {
      transfer.plan = text.value.trim() ? JSON.parse(text.value) : {};
    } catch (error) {
      fault.textContent = error.message;
      return;
    }
    again();
  };
  const priority = select([["-10", t("priority.low")], ["0", t("priority.usual")], ["10", t("priority.high")]], String(transfer.priority), (value) => { transfer.priority = Number(value); });
  const element = fold(t("plan.title"), false, field(t("plan.priority"), priority, t("plan.priority_hint")), field(t("plan.json"), text, t("plan.json_hint")), fault,
    h("button", { type: "button", class: "quiet", onclick: apply }, t("check.again")));
  return { element, show };
}
