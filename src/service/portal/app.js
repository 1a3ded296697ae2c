// The page: signing in, sending, the live queue, and the way to a job (#/jobs/ID).
import { bytes, call, count, Fault, h, json, send, when } from "./api.js";
import { showJob } from "./job.js";

const $ = (id) => document.getElementById(id);
const POLL_MS = 1000;
let leave = new AbortController();
let pages = 1;

function notice(error) {
  if (error?.name === "AbortError") return;
  const box = $("notice");
  box.hidden = !error;
  if (!error) return;
  const problem = error instanceof Fault ? error.problem : {};
  const single = (problem.errors ?? []).map((e) => e.message).filter((m) => m && m !== error.message);
  box.textContent = [`${error.message}${problem.code ? ` (${problem.code})` : ""}`, ...single].join(" · ");
}

async function signIn(key) {
  await call("/v1/session", { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify({ key }) });
  // The cookie itself cannot be read here: remember only that there is one.
  localStorage.setItem("session", "yes");
  $("sign-out").hidden = false;
}

function show(name) {
  for (const id of ["sign-in", "home", "job"]) $(id).hidden = id !== name;
}

async function route() {
  leave.abort();
  leave = new AbortController();
  const { signal } = leave;
  notice(null);
  const key = location.hash.match(/^#key=(vsk_[0-9a-f]+)$/);
  try {
    if (key) {
      // The key leaves the address bar and the history at once.
      history.replaceState(null, "", "#/");
      await signIn(key[1]);
    }
    const job = location.hash.match(/^#\/jobs\/([0-9a-f-]+)$/);
    if (job) {
      show("job");
      await showJob($("job"), job[1], signal, notice);
    } else {
      show("home");
      pages = 1;
      await watchQueue(signal);
    }
  } catch (error) {
    if (error.problem?.status === 401) show("sign-in");
    if (!(error.problem?.code === "auth.missing")) notice(error);
  }
}

async function watchQueue(signal) {
  while (!signal.aborted) {
    try {
      const items = [];
      let next = "/v1/jobs?limit=50";
      for (let i = 0; i < pages && next; i += 1) {
        const list = await json(next, { signal });
        items.push(...list.items);
        next = list.next;
      }
      fillQueue(items, next);
      const stats = await json("/v1/stats", { signal });
      $("stats").textContent = `${stats.jobs.queued} waiting · ${stats.workers_busy} of ${stats.workers} workers busy`;
      if ($("notice").dataset.offline) {
        delete $("notice").dataset.offline;
        notice(null);
      }
    } catch (error) {
      if (error.problem?.code !== "offline") throw error;
      $("notice").dataset.offline = "yes";
      notice(error);
    }
    await new Promise((resolve) => setTimeout(resolve, POLL_MS));
  }
}

function fillQueue(items, next) {
  $("empty").hidden = items.length > 0;
  $("older").hidden = !next;
  const body = $("queue");
  // A button under the finger must not be replaced: rows are redrawn only when they changed.
  const text = JSON.stringify(items);
  if (body.dataset.shown === text) return;
  body.dataset.shown = text;
  const focused = document.activeElement?.dataset?.job;
  body.replaceChildren(...items.map(row));
  if (focused) body.querySelector(`[data-job="${focused}"]`)?.focus();
}

function row(job) {
  const ends = !["succeeded", "failed", "cancelled"].includes(job.state);
  const cancel = h("button", {
    type: "button", class: "quiet", "data-job": job.id, "aria-label": `Cancel job ${job.id}`,
    onclick: () => call(job.links.cancel, { method: "POST" }).catch(notice),
  }, "Cancel");
  return h("tr", {},
    h("td", {}, h("a", { href: `#/jobs/${job.id}`, title: job.id }, `…${job.id.slice(-8)}`)),
    h("td", {}, h("span", { class: `state ${job.state}` }, job.state)),
    h("td", {}, job.error?.code ?? job.stage ?? "–"),
    h("td", {}, job.state === "running" ? h("progress", { max: 1, value: job.progress, "aria-label": "Progress" }) : "–"),
    h("td", {}, when(job.created_at)),
    h("td", { class: "number" }, `${job.input.files} (${bytes(job.input.bytes)})`),
    h("td", {}, ends ? cancel : ""));
}

function choose(list) {
  const files = [...list];
  $("chosen").textContent = files.length === 0 ? "" : `${count(files.length, "file", "files")}, ${bytes(files.reduce((n, f) => n + f.size, 0))}`;
  return files;
}

function prepareSending() {
  let files = [];
  const drop = $("drop");
  $("files").addEventListener("change", (e) => { files = choose(e.target.files); });
  for (const kind of ["dragover", "dragenter"]) drop.addEventListener(kind, (e) => { e.preventDefault(); drop.classList.add("over"); });
  drop.addEventListener("dragleave", () => drop.classList.remove("over"));
  drop.addEventListener("drop", (e) => {
    e.preventDefault();
    drop.classList.remove("over");
    files = choose(e.dataTransfer.files);
  });
  $("send").addEventListener("submit", async (e) => {
    e.preventDefault();
    notice(null);
    if (files.length === 0) return notice(new Error("Choose the files of a scan first."));
    const form = new FormData();
    const plan = $("plan").value.trim();
    if (plan) form.append("plan", plan);
    for (const file of files) form.append("input", file, file.name);
    const button = e.target.querySelector("button");
    button.disabled = true;
    $("sending").hidden = false;
    try {
      const job = await send(form, (part) => { $("sending").value = part; });
      files = choose([]);
      $("files").value = "";
      location.hash = `#/jobs/${job.id}`;
    } catch (error) {
      notice(error);
    } finally {
      button.disabled = false;
      $("sending").hidden = true;
    }
  });
}

$("sign-in").querySelector("form").addEventListener("submit", async (e) => {
  e.preventDefault();
  try {
    await signIn($("key").value.trim());
    $("key").value = "";
    await route();
  } catch (error) {
    notice(error);
  }
});
$("sign-out").addEventListener("click", async () => {
  await call("/v1/session", { method: "DELETE" }).catch(notice);
  leave.abort();
  localStorage.removeItem("session");
  $("sign-out").hidden = true;
  show("sign-in");
});
$("older").addEventListener("click", () => { pages += 1; });
window.addEventListener("signed-out", () => show("sign-in"));
window.addEventListener("hashchange", route);
$("sign-out").hidden = localStorage.getItem("session") !== "yes";
prepareSending();
route();
