// Views by hash: #/jobs, #/jobs/ID, #/send, #/compare?a=..&b=.., #/cohort, #/admin. Each view is a function
// (box, {params, query, signal}) that fills its box and lives until the signal aborts.
import { announce } from "./dom.js";
import { notice } from "./faults.js";
import { t } from "./text.js";

let leave = new AbortController();
let first = true;

export function readAddress(hash = location.hash) {
  const [path, query] = hash.replace(/^#\/?/, "").split("?");
  const parts = path.split("/").filter(Boolean).map(decodeURIComponent);
  return { name: parts[0] ?? "jobs", params: parts.slice(1), query: new URLSearchParams(query ?? "") };
}

// Changes the query of the present view without leaving it.
export function setQuery(values) {
  const { name, params, query } = readAddress();
  for (const [key, value] of Object.entries(values)) value ? query.set(key, value) : query.delete(key);
  const text = query.toString();
  history.replaceState(null, "", `#/${[name, ...params].join("/")}${text ? `?${text}` : ""}`);
}

// Ends the present view and takes away what it showed.
export function clear() {
  leave.abort();
  document.getElementById("view").replaceChildren();
}

export async function route(views) {
  leave.abort();
  leave = new AbortController();
  const { signal } = leave;
  const address = readAddress();
  const name = views[address.name] ? address.name : "jobs";
  const key = name === "jobs" && address.params.length > 0 ? "job" : name;
  notice(null);
  for (const link of document.querySelectorAll("nav a")) {
    if (link.dataset.view === name) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  document.title = `${t(`title.${key}`)} · Vasculum`;
  const box = document.getElementById("view");
  box.replaceChildren();
  box.className = `view-${key}`;
  if (!first) {
    // A reader of the screen starts at the new view; the page's own start keeps the browser's focus.
    box.focus({ preventScroll: true });
    window.scrollTo(0, 0);
    announce(t(`title.${key}`));
  }
  first = false;
  try {
    await views[key](box, { ...address, signal });
  } catch (error) {
    if (!signal.aborted) notice(error);
  }
}
