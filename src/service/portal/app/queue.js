// The jobs, live: filtered, sorted, cancelled, run again, moved; and what the machine has left.
import { button, card, field, h, redraw, redrawRows, select } from "./dom.js";
import { recovered, notice } from "./faults.js";
import { call, filePath, jobPath, json, pause } from "./net.js";
import { setQuery } from "./router.js";
import { mayChange } from "./session.js";
import { bytes, duration, number, t, when } from "./text.js";

const POLL_MS = 1000;
const FINAL = ["succeeded", "failed", "cancelled"];
const STATES = ["queued", "running", ...FINAL];

const seconds = (from, to) => (from ? ((to ? new Date(to) : Date.now()) - new Date(from)) / 1000 : NaN);
export const waited = (job) => seconds(job.created_at, job.started_at ?? job.finished_at);
export const ran = (job) => seconds(job.started_at, job.finished_at);

const COLUMNS = [
  { key: "created", title: "queue.sent", of: (j) => j.created_at },
  { key: "state", title: "queue.state", of: (j) => STATES.indexOf(j.state) },
  { key: "waited", title: "queue.waited", of: waited, number: true },
  { key: "ran", title: "queue.ran", of: (j) => ran(j) || 0, number: true },
  { key: "size", title: "queue.size", of: (j) => j.input.bytes, number: true },
  { key: "priority", title: "queue.priority", of: (j) => j.priority, number: true },
];

export async function showQueue(box, { query, signal }) {
  const view = { state: query.get("state") ?? "", text: query.get("text") ?? "", sort: query.get("sort") ?? "created", down: query.get("up") === null, pages: 1 };
  const parts = { stats: h("div", { class: "tiles" }), rows: h("tbody", { id: "queue" }), head: h("tr"), more: null, empty: h("p", { class: "empty", hidden: true }) };
  parts.more = h("button", { type: "button", class: "quiet", hidden: true, onclick: () => { view.pages += 1; } }, t("queue.older"));
  const changed = () => {
    setQuery({ state: view.state, text: view.text, sort: view.sort === "created" ? "" : view.sort, up: view.down ? "" : "1" });
    if (view.items) draw(view, parts, changed);
  };
  const search = h("input", { type: "search", value: view.text, placeholder: t("queue.search_hint"), oninput: () => { view.text = search.value; changed(); } });
  const state = select([["", t("queue.all")], ...STATES.map((s) => [s, t(`state.${s}`)])], view.state, (value) => { view.state = value; changed(); });
  box.append(h("div", { class: "title" }, h("h1", {}, t("title.jobs")), h("div", { class: "actions" }, mayChange() ? h("a", { class: "button", href: "#/send" }, t("nav.send")) : null)),
    parts.stats,
    card(null, h("div", { class: "filters" }, field(t("queue.search"), search), field(t("queue.state"), state)),
      h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": t("title.jobs") },
        h("table", { class: "jobs" }, h("caption", { class: "unseen" }, t("title.jobs")), h("thead", {}, parts.head), parts.rows)),
      parts.empty, parts.more));
  while (!signal.aborted) {
    await refresh(view, parts, changed, signal);
    await pause(document.hidden ? 5 * POLL_MS : POLL_MS, signal);
  }
}

async function refresh(view, parts, changed, signal) {
  try {
    const items = [];
    let next = `/v1/jobs?limit=100${view.state ? `&state=${view.state}` : ""}`;
    for (let i = 0; i < view.pages && next; i += 1) {
      const list = await json(next, { signal });
      items.push(...list.items);
      next = list.next;
    }
    const [stats, workers] = await Promise.all([json("/v1/stats", { signal }), json("/v1/workers", { signal })]);
    Object.assign(view, { items, next });
    draw(view, parts, changed);
    tiles(parts.stats, stats, workers.items);
    recovered("offline");
  } catch (error) {
    if (error.problem?.code !== "offline") throw error;
    notice(error);
  }
}

function tiles(box, stats, workers) {
  const memory = workers.reduce((n, w) => n + w.memory_mb, 0);
  const slots = workers.reduce((n, w) => n + w.slots, 0);
  // The roll is written every few seconds; what this process holds is known at once.
  const busy = Math.max(stats.workers_busy, workers.reduce((n, w) => n + w.busy, 0));
  const shown = [
    ["stats.waiting", String(stats.jobs.queued), stats.jobs.queued > 0 ? t("stats.oldest", { time: duration(stats.oldest_queued_s) }) : t("stats.none_waiting")],
    ["stats.running", String(stats.jobs.running), t("stats.workers", { busy, slots })],
    ["stats.done", String(stats.jobs.succeeded), t("stats.failed", { n: stats.jobs.failed })],
    ["stats.memory", bytes(memory * 1048576), t("stats.uploads", { free: bytes(stats.upload_memory_free) })],
    ["stats.disk", bytes(stats.disk_free), t("stats.disk_of")],
  ];
  redraw(box, shown, () => shown.map(([key, value, note]) => h("div", { class: "tile" }, h("span", { class: "soft" }, t(key)), h("strong", {}, value), h("span", { class: "soft" }, note))));
}

const matches = (job, text) =>
  [job.id, job.state, t(`state.${job.state}`), job.stage, job.error?.code, job.error?.detail, job.sent_by, job.input.digest].some((part) => part?.toLowerCase().includes(text));

function draw(view, parts, changed) {
  const column = COLUMNS.find((c) => c.key === view.sort) ?? COLUMNS[0];
  const text = view.text.trim().toLowerCase();
  const items = view.items.filter((job) => (!view.state || job.state === view.state) && (!text || matches(job, text)));
  const order = (a, b) => (column.of(a) < column.of(b) ? -1 : column.of(a) > column.of(b) ? 1 : a.id < b.id ? -1 : 1);
  items.sort((a, b) => (view.down ? order(b, a) : order(a, b)));
  redraw(parts.head, [view.sort, view.down], () => [h("th", { scope: "col" }, t("queue.job")), ...COLUMNS.map((c) => heading(c, view, changed)), h("th", { scope: "col" }, t("queue.actions"))]);
  redrawRows(parts.rows, items, (job) => job.id, row);
  // Times tick in place.
  for (const cell of parts.rows.querySelectorAll("[data-tick]")) {
    const job = items.find((j) => j.id === cell.dataset.job);
    if (job) cell.textContent = duration(cell.dataset.tick === "waited" ? waited(job) : ran(job));
  }
  parts.empty.hidden = items.length > 0;
  parts.empty.textContent = view.items.length === 0 && !view.state ? t("queue.none") : t("queue.no_match");
  parts.more.hidden = !view.next;
}

function heading(column, view, changed) {
  const active = column.key === view.sort;
  return h("th", { scope: "col", class: `${column.number ? "number " : ""}c-${column.key}`, "aria-sort": active ? (view.down ? "descending" : "ascending") : null },
    h("button", { type: "button", class: "sort", "data-key": `sort-${column.key}`, onclick: () => {
      view.down = active ? !view.down : true;
      view.sort = column.key;
      changed();
    } }, t(column.title), active ? (view.down ? " ↓" : " ↑") : ""));
}

export function stateCell(job, { fault = true } = {}) {
  const words = [h("span", { class: `state ${job.state}` }, t(job.cancel_requested && job.state === "running" ? "state.cancelling" : `state.${job.state}`))];
  if (job.state === "running") {
    const left = typeof job.eta_s === "number" ? t("send.left", { time: duration(job.eta_s) }) : "";
    words.push(h("progress", { max: 1, value: job.progress, "aria-label": t("job.progress") }), h("span", { class: "soft" }, [job.stage ? stageName(job.stage) : t("job.starting"), left].filter(Boolean).join(" · ")));
  }
  if (job.error && fault) words.push(h("code", {}, job.error.code), h("span", { class: "soft clip", title: job.error.detail }, job.error.detail));
  return words;
}

export const stageName = (stage) => t(`stage.${stage}`).replace(/^stage\./, "");

function row(job) {
  const name = job.id.slice(-8);
  const thumb = job.state === "succeeded" ? h("img", { class: "thumb", src: filePath(job.id, "preview.png"), alt: "", loading: "lazy", width: 64, height: 48 }) : h("span", { class: "thumb none", "aria-hidden": "true" });
  return h("tr", {},
    h("td", {}, h("a", { class: "job-link", href: `#/jobs/${job.id}`, title: job.id, "data-key": `open-${job.id}` }, thumb, h("span", {}, name))),
    h("td", { class: "c-created" }, when(job.created_at, "short"), job.sent_by && job.sent_by !== "open" ? [h("br"), h("span", { class: "soft" }, job.sent_by)] : null),
    // A narrow page has no column for it.
    h("td", { class: "state-cell" }, stateCell(job), h("span", { class: "soft narrow" }, `${t("queue.waited")}: `, h("span", { "data-tick": "waited", "data-job": job.id }, duration(waited(job))))),
    h("td", { class: "number c-waited", "data-tick": "waited", "data-job": job.id }, duration(waited(job))),
    h("td", { class: "number c-ran", "data-tick": "ran", "data-job": job.id }, duration(ran(job))),
    h("td", { class: "number c-size" }, `${bytes(job.input.bytes)}`, h("br"), h("span", { class: "soft" }, t("count.files", { n: job.input.files }))),
    h("td", { class: "number" }, job.state === "queued" && mayChange() ? mover(job) : String(job.priority)),
    h("td", {}, h("div", { class: "actions" }, actions(job, { name }))));
}

function mover(job) {
  const move = (by) => call(`${jobPath(job.id)}/priority?priority=${Math.max(-100, Math.min(100, job.priority + by))}`, { method: "POST" });
  const name = job.id.slice(-8);
  return h("span", { class: "mover" },
    button("−", () => move(-10), { class: "quiet", "data-key": `down-${job.id}`, "aria-label": t("queue.lower", { name }) }),
    h("span", {}, number(job.priority, 0)),
    button("+", () => move(10), { class: "quiet", "data-key": `up-${job.id}`, "aria-label": t("queue.higher", { name }) }));
}

// The buttons that fit a job's state.
export function actions(job, { name, after = () => {} }) {
  const act = (key, path, method, label) => button(t(key), async () => { await call(path, { method }); after(key); },
    { class: "quiet", "data-key": `${key}-${job.id}`, "aria-label": `${t(key)} ${label}` });
  return [
    FINAL.includes(job.state) || !mayChange() ? null : act("action.cancel", `${jobPath(job.id)}/cancel`, "POST", name),
    job.state === "failed" && mayChange() ? act("action.retry", `${jobPath(job.id)}/retry`, "POST", name) : null,
    job.state === "succeeded" ? h("a", { class: "button quiet", href: `#/compare?a=${job.id}`, "data-key": `compare-${job.id}`, "aria-label": `${t("action.compare")} ${name}` }, t("action.compare")) : null,
  ];
}

export const isFinal = (job) => FINAL.includes(job.state);
