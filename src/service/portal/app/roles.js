// Who is who at the junction, corrected by a click: the same scan is reconstructed again with the roles said by points.
import { button, field, h, select } from "./dom.js";
import { jobPath, json, post } from "./net.js";
import { roleName, t } from "./text.js";

const ROLES = ["graft", "proximal", "distal"];

// A point of a branch two thirds along it, away from the junction.
const pointOf = (branch) => branch.samples.position[Math.floor((branch.samples.position.length * 2) / 3)];

export function rolesPanel(job, found, signal) {
  const branches = found.branches.filter((b) => b.samples?.position?.length > 0);
  if (branches.length < 3 || (found.junctions ?? []).length === 0) return null;
  const chosen = Object.fromEntries(ROLES.map((role, i) => [role, String((branches.find((b) => b.role === role) ?? branches[i]).id)]));
  const fault = h("p", { class: "bad", role: "alert" });
  const run = button(t("roles.run"), async () => {
    if (new Set(Object.values(chosen)).size < ROLES.length) {
      fault.textContent = t("roles.twice");
      return;
    }
    const plan = await json(`${jobPath(job.id)}/plan`, { signal });
    plan.roles = Object.fromEntries(ROLES.map((role) => [`${role}_mm`, pointOf(branches.find((b) => String(b.id) === chosen[role])).map((x) => Number(x.toFixed(2)))]));
    const next = await (await post("/v1/jobs", { job: job.id, plan })).json();
    location.hash = `#/jobs/${next.id}`;
  }, { id: "run-roles" });
  const options = branches.map((b) => [String(b.id), roleName(b)]);
  const swap = button(t("roles.swap"), async () => {
    [chosen.proximal, chosen.distal] = [chosen.distal, chosen.proximal];
    for (const role of ROLES) document.getElementById(`role-${role}`).value = chosen[role];
  }, { class: "quiet" });
  return h("details", { class: "card roles" }, h("summary", {}, t("roles.title")),
    h("p", { class: "soft" }, t("roles.why")),
    h("div", { class: "fields" }, ROLES.map((role) => field(t(`role.${role}`), select(options, chosen[role], (id) => { chosen[role] = id; fault.textContent = ""; }, { id: `role-${role}` })))),
    fault, h("div", { class: "actions" }, run, swap));
}
