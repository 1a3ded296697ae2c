// The page inside another page's frame: one result by a short-lived link (#/jobs/ID?link=vsl_...), without the page's own
// navigation and without anything that changes something.
import { button, h } from "./dom.js";
import { jobPath, post, useToken } from "./net.js";
import { readAddress } from "./router.js";
import { t, when } from "./text.js";

export const embedded = location.pathname === "/embed";

export function startEmbedded() {
  document.body.classList.add("embedded");
  useToken(readAddress().query.get("link"));
}

// Makes a link and shows it, for whoever sets up the other page.
export const shareButton = (job) => button(t("share.make"), async () => {
  const made = await (await post(`${jobPath(job.id)}/links`)).json();
  const address = new URL(made.url, location.origin).href;
  const value = h("input", { readonly: true, value: address, "aria-label": t("share.link"), onfocus: (e) => e.target.select() });
  const dialog = h("dialog", { "aria-labelledby": "share-title", onclose: () => dialog.remove() },
    h("form", { method: "dialog" }, h("h2", { id: "share-title" }, t("share.title")),
      h("p", {}, made.expires_at ? t("share.until", { when: when(made.expires_at) }) : t("share.open")), value,
      h("div", { class: "actions" }, button(t("action.copy"), () => navigator.clipboard.writeText(address), { class: "quiet" }), h("button", {}, t("action.close")))));
  document.body.append(dialog);
  dialog.showModal();
}, { class: "quiet" });
