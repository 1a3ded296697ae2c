// What went wrong, in words: the service's own sentence, its code, the place in the scan, and what to do about it.
import { h } from "./dom.js";
import { Fault } from "./net.js";
import { has, place, t } from "./text.js";

const hint = (code) => {
  const family = `${(code ?? "").split(".")[0]}.*`;
  return [code, family].map((c) => `hint.${c}`).find(has);
};

// A problem (RFC 9457) as elements.
export function problemBox(problem, title) {
  const own = (problem.errors ?? []).filter((e) => e.message && e.message !== problem.detail);
  const single = own.map((e) => h("li", {}, h("code", {}, e.code ?? ""), ` ${e.message}${place(e.where) ? ` (${place(e.where)})` : ""}`));
  const where = own.length === 0 ? place((problem.errors ?? [])[0]?.where) : "";
  const next = hint(problem.code);
  return h("section", { class: "card fault", role: "group", "aria-label": title },
    h("h2", {}, title),
    h("p", {}, h("code", {}, problem.code ?? ""), ` ${problem.detail ?? ""}`),
    where ? h("p", {}, h("strong", {}, `${t("fault.place")}: `), where) : null,
    single.length > 0 ? h("ul", {}, single) : null,
    next ? h("p", {}, h("strong", {}, `${t("fault.next")}: `), t(next)) : null,
    problem.trace_id ? h("p", { class: "soft" }, `${t("fault.trace")} `, h("code", {}, problem.trace_id)) : null);
}

let shown = null;

// The page's one place for faults of what a user did; null takes it away.
export function notice(error) {
  if (error?.name === "AbortError") return;
  const box = document.getElementById("notice");
  box.hidden = !error;
  shown = error ?? null;
  if (!error) return box.replaceChildren();
  const problem = error instanceof Fault ? error.problem : {};
  const next = hint(problem.code);
  box.replaceChildren(
    h("p", {}, error.message, problem.code ? [" ", h("code", {}, problem.code)] : null, next ? ` ${t(next)}` : null),
    h("button", { type: "button", class: "quiet", onclick: () => notice(null) }, t("action.close")));
}

// Takes the notice away if it is of that code (the service answers again).
export function recovered(code) {
  if (shown?.problem?.code === code) notice(null);
}
