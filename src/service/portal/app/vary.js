// What if: variants of this result (a branch turned, bent, twisted, straightened, pressed flat), several in one call, and the
// list of those that were made, each beside its parent at a press.
import { button, field, h, redraw, select, table } from "./dom.js";
import { jobPath, json, lasting, pause, post } from "./net.js";
import { number, roleName, t } from "./text.js";

const NAMED = ["graft", "proximal", "distal", "host_a", "host_b"];
// What can be asked for, with the values that are proposed.
const KINDS = { angle: "30, 60", bend: "0.5", curvature: "0.02", straight: null, planar: null };
const DIGITS = { angle: 1, bend: 2, curvature: 3 };

// A branch in the words of a plan: its role where nobody else has it, else its number.
const named = (branch) => (NAMED.includes(branch.role) && !(branch.twins > 1) ? branch.role : branch.id);

// "30, 45" as numbers; null where one is none.
function valuesOf(text) {
  const values = text.split(/[\s,;]+/).filter(Boolean).map(Number);
  return values.length > 0 && values.every(Number.isFinite) ? values : null;
}

function changeOf(kind, branch, value, { to, torsion }) {
  const change = { branch: named(branch) };
  if (kind === "angle") return { ...change, angle_deg: value, to: named(to) };
  if (kind === "bend") return { ...change, curvature_factor: value };
  if (kind === "curvature") return { ...change, curvature_per_mm: value, torsion_per_mm: torsion };
  return { ...change, [kind]: true };
}

function words(change, found) {
  const name = (which) => roleName(found.branches.find((b) => b.role === which || b.id === which) ?? { role: "other", id: which });
  const branch = name(change.branch);
  if (change.angle_deg !== undefined) return t("vary.of_angle", { branch, value: number(change.angle_deg), to: name(change.to ?? "proximal") });
  if (change.curvature_factor !== undefined) return t("vary.of_bend", { branch, value: number(change.curvature_factor, 2) });
  if (change.curvature_per_mm !== undefined) return t("vary.of_curvature", { branch, value: number(change.curvature_per_mm, 3), torsion: number(change.torsion_per_mm ?? 0, 3) });
  return t(change.straight ? "vary.of_straight" : "vary.of_planar", { branch });
}

export function varyPanel(job, found, signal) {
  const branches = found.branches.filter((b) => b.samples?.position?.length > 0);
  if (branches.length === 0) return null;
  const of = (id) => branches.find((b) => String(b.id) === id);
  const asked = { kind: "angle", branch: String((branches.find((b) => b.role === "graft") ?? branches[0]).id), to: String((branches.find((b) => b.role === "proximal") ?? branches[1] ?? branches[0]).id), values: KINDS.angle, torsion: "0" };
  const options = branches.map((b) => [String(b.id), roleName(b)]);
  const fault = h("p", { class: "bad", role: "alert" });
  const fields = h("div", { class: "fields" });
  const list = h("div");
  const input = (key) => h("input", { id: `vary-${key}`, value: asked[key], inputmode: "decimal", oninput: (e) => { asked[key] = e.target.value; fault.textContent = ""; } });
  const pick = (key) => field(t(`vary.${key}`), select(options, asked[key], (id) => { asked[key] = id; }, { id: `vary-${key}` }));
  const draw = () => fields.replaceChildren(...[
    field(t("vary.kind"), select(Object.keys(KINDS).map((kind) => [kind, t(`vary.kind_${kind}`)]), asked.kind, (kind) => {
      Object.assign(asked, { kind, values: KINDS[kind] ?? "" });
      draw();
      document.getElementById("vary-kind").focus();
    }, { id: "vary-kind" })),
    pick("branch"),
    asked.kind === "angle" ? pick("to") : null,
    KINDS[asked.kind] === null ? null : field(t(`vary.values_${asked.kind}`), input("values"), t("vary.several")),
    asked.kind === "curvature" ? field(t("vary.torsion"), input("torsion")) : null,
  ].filter(Boolean));
  const run = button(t("vary.run"), async () => {
    const [branch, to] = [of(asked.branch), of(asked.to)];
    const values = KINDS[asked.kind] === null ? [null] : valuesOf(asked.values);
    const torsion = Number(asked.torsion);
    if (!values || !Number.isFinite(torsion)) fault.textContent = t("vary.no_number");
    else if (asked.kind === "angle" && branch === to) fault.textContent = t("vary.itself");
    else {
      const plans = values.map((value) => ({ variant: { changes: [changeOf(asked.kind, branch, value, { to, torsion })] } }));
      await post(`${jobPath(job.id)}/plans`, { plans });
      await made(list, job, found, signal);
    }
  }, { id: "run-vary" });
  draw();
  made(list, job, found, signal).catch(() => {});
  return h("details", { class: "card vary" }, h("summary", {}, t("vary.title")), h("p", { class: "soft" }, t("vary.why")), fields, fault, h("div", { class: "actions" }, run), list);
}

// The variants that there are, and what becomes of those that are not ready; ends when all are.
let watched = 0;
async function made(box, job, found, signal) {
  watched += 1;
  const mine = watched;
  while (!signal.aborted && mine === watched) {
    const jobs = (await json(`/v1/jobs?parent=${encodeURIComponent(job.id)}&limit=100`, { signal })).items.filter((j) => j.kind === "variant");
    const plans = await Promise.all(jobs.map((j) => lasting(`${jobPath(j.id)}/plan`)));
    redraw(box, jobs.map((j) => [j.id, j.state, j.stage]), () => (jobs.length === 0 ? [] : [table(t("vary.made"), [{ title: t("vary.change") }, { title: t("queue.state") }, { title: t("action.compare") }], jobs.map((j, i) => lineOf(job, j, plans[i], found)))]));
    if (jobs.every((j) => !["queued", "running"].includes(j.state))) return;
    await pause(1500, signal);
  }
}

function lineOf(parent, job, plan, found) {
  const what = (plan.variant?.changes ?? []).map((change) => words(change, found)).join("; ") || t("vary.of_nothing");
  const state = job.error ? h("span", { class: "bad" }, job.error.detail) : t(`state.${job.state}`);
  const ready = job.state === "succeeded";
  return [h("a", { href: `#/jobs/${job.id}`, "data-key": job.id }, what), state,
    ready ? h("a", { href: `#/compare?a=${parent.id}&b=${job.id}`, "aria-label": t("vary.beside", { what }) }, t("action.compare")) : ""];
}
