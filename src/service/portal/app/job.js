// One job: what happens, why it failed, or its result.
import { check } from "./check.js";
import { announce, button, h, sure } from "./dom.js";
import { embedded, shareButton } from "./embed.js";
import { problemBox } from "./faults.js";
import { call, jobPath, json, post } from "./net.js";
import { actions, isFinal, ran, stageName, stateCell, waited } from "./queue.js";
import { showResult } from "./result.js";
import { mayChange } from "./session.js";
import { bytes, duration, t, when } from "./text.js";
import { Held } from "./transfer.js";

const STAGES = ["read", "contours", "fit", "polygonise", "smooth", "skeleton", "mesh", "measure", "write"];

export async function showJob(box, { params, query, signal }) {
  const id = params[0];
  box.append(h("p", { class: "busy", role: "status" }, t("job.reading")));
  // The viewer's code is on its way while the numbers are.
  import("./view3d.js").catch(() => {});
  let job = await json(jobPath(id), { signal });
  const parts = { line: h("div", { class: "state-line" }), steps: h("ol", { class: "steps" }) };
  draw(box, job, parts, signal);
  while (!signal.aborted && !isFinal(job)) {
    // The stream ends with the job; a broken one is taken up again.
    await follow(job, parts, signal);
    job = await json(jobPath(id), { signal });
    if (isFinal(job)) announce(t("job.ended", { state: t(`state.${job.state}`) }));
    draw(box, job, parts, signal);
  }
  if (job.state === "succeeded") await showResult(box, job, { query, signal });
}

// The job's events, read as a stream so that a session by cookie or by key serves alike.
async function follow(job, parts, signal) {
  try {
    const response = await call(`${jobPath(job.id)}/events`, { headers: { accept: "text/event-stream" }, signal });
    const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
    let rest = "";
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return;
      const blocks = (rest + value).split("\n\n");
      rest = blocks.pop();
      for (const block of blocks) {
        const data = block.split("\n").filter((line) => line.startsWith("data:")).map((line) => line.slice(5)).join("\n");
        if (!data) continue;
        Object.assign(job, JSON.parse(data));
        progress(job, parts);
      }
    }
  } catch (error) {
    if (signal.aborted || error.problem) throw error;
    await new Promise((resolve) => setTimeout(resolve, 1000));
  }
}

function progress(job, { line, steps }) {
  line.replaceChildren(...stateCell(job, { fault: false }));
  const now = STAGES.indexOf(job.stage);
  steps.hidden = isFinal(job);
  steps.replaceChildren(...STAGES.map((stage, i) => h("li", { class: i < now ? "past" : i === now ? "now" : null, "aria-current": i === now ? "step" : null }, stageName(stage))));
}

// A failed job's scan beside its plan, to place a seed or mend a field and run it again.
function mending(job, signal) {
  const box = h("div");
  const open = button(t("job.mend"), async () => {
    const plan = await json(`${jobPath(job.id)}/plan`, { signal });
    open.hidden = true;
    check(box, new Held(job.id, plan, job.error.code), signal);
  }, { id: "mend" });
  return h("section", { class: "card mend", "aria-label": t("job.mend") }, open, box);
}

function draw(box, job, parts, signal) {
  const name = job.id.slice(-8);
  const again = () => window.dispatchEvent(new Event("hashchange"));
  const erase = button(t("action.erase"), async () => {
    if (!(await sure(t("job.erase_sure", { name }), t("action.erase")))) return;
    await call(jobPath(job.id), { method: "DELETE" });
    location.hash = "#/jobs";
  }, { class: "quiet" });
  // A failed job is tried again itself.
  const rerun = job.state === "succeeded" && mayChange() ? button(t("action.again"), async () => {
    const next = await (await post("/v1/jobs", { job: job.id })).json();
    location.hash = `#/jobs/${next.id}`;
  }, { class: "quiet" }) : null;
  const report = job.state === "succeeded" && !embedded ? h("a", { class: "button", href: `${jobPath(job.id)}/artefacts/report.html`, target: "_blank", rel: "noopener" }, t("job.report")) : null;
  box.replaceChildren(
    h("div", { class: "title" },
      h("h1", {}, t("job.title", { name })), parts.line,
      h("div", { class: "actions" }, report, embedded ? null : [actions(job, { name, after: again }), rerun, job.state === "succeeded" && mayChange() ? shareButton(job) : null, isFinal(job) && mayChange() ? erase : null])),
    h("p", { class: "soft facts-line" }, t("job.facts", { when: [when(job.created_at), job.sent_by === "open" ? "" : job.sent_by].filter(Boolean).join(", "), files: t("count.files", { n: job.input.files }), size: bytes(job.input.bytes), waited: duration(waited(job)), ran: duration(ran(job)) })),
    parts.steps);
  progress(job, parts);
  if (job.error) box.append(problemBox(job.error, t("job.why")), mayChange() ? mending(job, signal) : "");
  if (job.state === "cancelled") box.append(h("p", { class: "empty" }, t("job.cancelled")));
}
