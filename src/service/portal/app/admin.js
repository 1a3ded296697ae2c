// What an administrator sets (keys, retention) and an auditor reads (the audit); the workers of every machine.
import { button, card, field, h, select, sure, table } from "./dom.js";
import { call, json, post } from "./net.js";
import { whoami } from "./session.js";
import { bytes, has, t, when } from "./text.js";

const ROLES = ["upload", "read", "auditor", "admin"];
// Lines of the audit that are shown at once.
const SHOWN = 200;

export async function showAdmin(box, { signal }) {
  const who = await whoami();
  box.append(h("h1", {}, t("title.admin")), h("p", { class: "soft" }, t("admin.who", { tenant: who.tenant, role: t(`key.${who.role}`) })));
  if (who.role !== "admin" && who.role !== "auditor") return box.append(h("p", { class: "empty" }, t("admin.forbidden")));
  const grid = h("div", { class: "admin-grid" });
  const audit = h("div", { class: "wide" });
  // What is done here is seen in the audit at once.
  const done = () => drawAudit(audit, signal);
  box.append(grid);
  if (who.role === "admin") {
    const keys = h("div", { class: "wide" });
    grid.append(keys, tenantCard(await json("/v1/tenant", { signal }), done), await workersCard(signal));
    await drawKeys(keys, done, signal);
  }
  grid.append(audit);
  await done();
}

async function drawKeys(box, done, signal) {
  const { items } = await json("/v1/keys", { signal });
  const rows = items.map((key) => [key.label, t(`key.${key.role}`), when(key.created_at), key.revoked_at ? t("key.revoked", { when: when(key.revoked_at) }) : t("key.valid"),
    key.revoked_at ? "" : button(t("key.revoke"), async () => {
      if (!(await sure(t("key.revoke_sure", { label: key.label }), t("key.revoke")))) return;
      await call(`/v1/keys/${key.id}`, { method: "DELETE" });
      await Promise.all([drawKeys(box, done, signal), done()]);
    }, { class: "quiet small", "aria-label": `${t("key.revoke")} ${key.label}` })]);
  const columns = ["label", "role", "made", "state", "actions"].map((k) => ({ title: t(`key.${k}`) }));
  box.replaceChildren(card(t("key.title"), table(t("key.title"), columns, rows), keyForm(box, done, signal)));
}

function keyForm(box, done, signal) {
  const label = h("input", { required: true, maxlength: 100, autocomplete: "off" });
  const state = { role: "upload" };
  const role = select(ROLES.map((r) => [r, t(`key.${r}`)]), state.role, (value) => { state.role = value; });
  return h("form", {
    class: "filters", onsubmit: async (e) => {
      e.preventDefault();
      try {
        const made = await (await post("/v1/keys", { label: label.value.trim(), role: state.role })).json();
        showKey(made.key);
        await Promise.all([drawKeys(box, done, signal), done()]);
      } catch (error) {
        window.dispatchEvent(new CustomEvent("fault", { detail: error }));
      }
    },
  }, field(t("key.label"), label), field(t("key.role"), role), h("button", { type: "submit" }, t("key.make")));
}

function showKey(key) {
  const value = h("input", { readonly: true, value: key, "aria-label": t("key.new"), onfocus: (e) => e.target.select() });
  const dialog = h("dialog", { "aria-labelledby": "new-key", onclose: () => dialog.remove() },
    h("form", { method: "dialog" }, h("h2", { id: "new-key" }, t("key.new")), h("p", {}, t("key.once")), value,
      h("div", { class: "actions" }, button(t("action.copy"), () => navigator.clipboard.writeText(key), { class: "quiet" }), h("button", {}, t("action.close")))));
  document.body.append(dialog);
  dialog.showModal();
}

function tenantCard(tenant, done) {
  const number = (value, min) => h("input", { type: "number", min, step: "any", value: value ?? "", placeholder: t("tenant.unbounded") });
  const [days, running] = [number(tenant.retention_days, "0.001"), number(tenant.max_running, "1")];
  const said = h("p", { class: "soft", role: "status" });
  const read = (input) => (input.value === "" ? null : Number(input.value));
  return card(t("tenant.title"), h("form", {
    class: "fields", onsubmit: async (e) => {
      e.preventDefault();
      said.textContent = "";
      try {
        await call("/v1/tenant", { method: "PUT", headers: { "content-type": "application/json" }, body: JSON.stringify({ retention_days: read(days), max_running: read(running) }) });
        said.textContent = t("tenant.saved");
        await done();
      } catch (error) {
        window.dispatchEvent(new CustomEvent("fault", { detail: error }));
      }
    },
  }, field(t("tenant.retention"), days, t("tenant.retention_hint")), field(t("tenant.running"), running), h("button", { type: "submit" }, t("tenant.save")), said));
}

async function workersCard(signal) {
  const { items } = await json("/v1/workers", { signal });
  const rows = items.map((w) => [w.host, w.version, `${w.busy} / ${w.slots}`, bytes(w.memory_mb * 1048576), when(w.started_at)]);
  const columns = ["host", "version", "busy", "memory", "since"].map((k) => ({ title: t(`worker.${k}`) }));
  return card(t("worker.title"), rows.length > 0 ? table(t("worker.title"), columns, rows) : h("p", { class: "empty" }, t("worker.none")));
}

async function drawAudit(box, signal) {
  const lines = h("tbody");
  const state = { next: "/v1/audit", events: [], action: "" };
  const search = h("input", { type: "search", oninput: () => draw() });
  const names = await keyNames(signal);
  // Oldest first by the service; the newest matter most here.
  for (let page = 0; state.next && page < 20; page += 1) {
    const list = await json(state.next, { signal });
    state.events.unshift(...list.items.map((event) => readEvent(event, names)).reverse());
    state.next = list.next;
  }
  const actions = [...new Set(state.events.map((e) => e.action))].sort();
  const action = select([["", t("queue.all")], ...actions.map((a) => [a, actionName(a)])], "", (value) => { state.action = value; draw(); });
  const draw = () => {
    const text = search.value.trim().toLowerCase();
    const rows = state.events.filter((e) => (!state.action || e.action === state.action) && e.cells.join(" ").toLowerCase().includes(text)).slice(0, SHOWN);
    lines.replaceChildren(...rows.map((e) => h("tr", {}, e.cells.map((cell) => h("td", {}, cell)))));
  };
  draw();
  const columns = ["when", "who", "what", "object"].map((k) => h("th", { scope: "col" }, t(`audit.${k}`)));
  box.replaceChildren(card(t("audit.title"), h("div", { class: "filters" }, field(t("queue.search"), search), field(t("audit.what"), action)),
    h("div", { class: "scroll tall", tabindex: "0", role: "region", "aria-label": t("audit.title") }, h("table", { class: "audit" }, h("caption", { class: "unseen" }, t("audit.title")), h("thead", {}, h("tr", {}, columns)), lines)),
    h("p", { class: "soft note" }, t("audit.note"), " ", h("code", {}, "vasculum verify-audit"))));
}

// What keys are for, by id; an auditor reads ids.
async function keyNames(signal) {
  if ((await whoami()).role !== "admin") return {};
  const { items } = await json("/v1/keys", { signal });
  return Object.fromEntries(items.map((key) => [key.id, key.label]));
}

const actionName = (action) => (has(`audit.${action}`) ? t(`audit.${action}`) : action);

function readEvent(event, names) {
  const action = event.subtype?.[0]?.code ?? "";
  const who = event.agent?.[0]?.who?.identifier?.value ?? "";
  return { action, cells: [when(event.recorded, "medium", "medium"), names[who] ? `${names[who]} (${who.slice(-8)})` : who, actionName(action), event.entity?.[0]?.what?.identifier?.value ?? ""] };
}
