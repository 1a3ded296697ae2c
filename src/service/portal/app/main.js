// The page: texts, theme, session, and the way to the views.
import { showAdmin } from "./admin.js";
import { showCohort } from "./cohort.js";
import { showCompare } from "./compare.js";
import { h, select } from "./dom.js";
import { embedded, startEmbedded } from "./embed.js";
import { notice } from "./faults.js";
import { showJob } from "./job.js";
import { showQueue } from "./queue.js";
import { clear, readAddress, route } from "./router.js";
import { showSend } from "./send.js";
import { endSession, isAuditor, startSession, whoami } from "./session.js";
import { LANGUAGES, currentLanguage, loadTexts, setLanguage, t } from "./text.js";
import { applyTheme, nextTheme } from "./theme.js";
import { onTransfers } from "./transfer.js";

const VIEWS = { jobs: showQueue, job: showJob, send: showSend, compare: showCompare, cohort: showCohort, admin: showAdmin };
const NAV = ["send", "jobs", "compare", "cohort", "admin"];
// What a role finds: the service refuses the rest anyway.
const MAY = { read: ["jobs", "compare", "cohort"], upload: ["send", "jobs", "compare", "cohort"], auditor: ["admin"] };
const SIGNS = { auto: "◐", light: "☀", dark: "☾" };
const go = () => {
  if (isAuditor() && readAddress().name === "jobs") history.replaceState(null, "", "#/admin");
  return route(VIEWS);
};

function drawHeader() {
  const running = h("span", { id: "running", class: "badge", hidden: true });
  const links = NAV.map((name) => h("a", { href: `#/${name}`, "data-view": name }, t(`nav.${name}`), name === "send" ? running : null));
  const theme = h("button", { type: "button", class: "quiet", id: "theme", onclick: () => { nextTheme(); tell(); } });
  const tell = () => {
    const now = document.documentElement.dataset.theme ?? "auto";
    theme.textContent = SIGNS[now];
    theme.title = t(`theme.${now}`);
    theme.setAttribute("aria-label", t(`theme.${now}`));
  };
  tell();
  const language = select(Object.entries(LANGUAGES), currentLanguage(), async (name) => {
    await setLanguage(name);
    document.getElementById("foot").textContent = t("foot.research");
    drawHeader();
    go();
  }, { "aria-label": t("language.label"), class: "quiet" });
  const out = h("button", { type: "button", class: "quiet", id: "sign-out", hidden: true, onclick: () => { clear(); endSession().then(go).catch(notice); } }, t("session.end"));
  document.getElementById("skip").textContent = t("nav.skip");
  document.getElementById("header").replaceChildren(
    h("a", { class: "brand", href: "#/jobs" }, h("img", { src: "/portal/icon.svg", alt: "", width: 26, height: 26 }), "Vasculum"),
    h("nav", { "aria-label": t("nav.label") }, links),
    h("div", { class: "tools" }, language, theme, out));
  whoami().then((who) => {
    out.hidden = !who.keys;
    for (const link of links) link.hidden = !(MAY[who.role] ?? NAV).includes(link.dataset.view);
  }).catch(() => {});
}

onTransfers((n) => {
  const badge = document.getElementById("running");
  if (!badge) return;
  badge.hidden = n === 0;
  badge.textContent = String(n);
  badge.setAttribute("aria-label", t("nav.uploads", { n }));
});
// A closed page would break off what is being sent.
window.addEventListener("beforeunload", (e) => document.getElementById("running")?.hidden === false && e.preventDefault());
window.addEventListener("fault", (e) => notice(e.detail));
window.addEventListener("session", drawHeader);
applyTheme();
const texts = loadTexts();
if (embedded) {
  await texts;
  startEmbedded();
} else {
  // The session is asked for while the texts are on their way.
  await startSession(texts);
  await texts;
  drawHeader();
}
document.getElementById("foot").textContent = t("foot.research");
window.addEventListener("hashchange", go);
go();
