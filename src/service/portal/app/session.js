// Signing in: at the start by a key in the address (#key=...), later by a dialog that comes whenever the session has ended,
// over whatever the user was doing; what waited goes on afterwards.
import { announce, h } from "./dom.js";
import { call, json, onSignedOut, signedIn } from "./net.js";
import { t } from "./text.js";

// A cookie that says that there is a session, which the session's own does not tell to scripts; the browser forgets both together.
const HINT = "signed_in=1";

let asking = null;
let known = null;

async function begin(key) {
  await call("/v1/session", { method: "POST", once: true, headers: { "content-type": "application/json" }, body: JSON.stringify({ key }) });
  document.cookie = `${HINT}; path=/; samesite=strict`;
  known = await json("/v1/session", { once: true });
}

// Whether who is signed in may send, cancel, run again, erase: what cannot be done is not offered. The service refuses it anyway.
export const mayChange = () => ["upload", "admin"].includes(known?.role);

// An auditor sees the audit and nothing else.
export const isAuditor = () => known?.role === "auditor";

// Who is signed in: {keys, tenant, role}.
export async function whoami() {
  known ??= await json("/v1/session");
  return known;
}

function ask() {
  asking ??= new Promise((resolve) => {
    const key = h("input", { id: "key", name: "key", type: "password", autocomplete: "off", required: true, placeholder: "vsk_…", "aria-describedby": "key-fault" });
    const fault = h("p", { id: "key-fault", class: "bad", role: "alert" });
    const dialog = h("dialog", { id: "sign-in", "aria-labelledby": "sign-in-title", oncancel: (e) => e.preventDefault() },
      h("form", {
        onsubmit: async (e) => {
          e.preventDefault();
          fault.textContent = "";
          try {
            await begin(key.value.trim());
          } catch (error) {
            fault.textContent = error.message;
            key.select();
            return;
          }
          asking = null;
          dialog.close();
          dialog.remove();
          announce(t("session.begun"));
          window.dispatchEvent(new Event("session"));
          resolve();
        },
      },
      h("h1", { id: "sign-in-title" }, t("session.title")),
      h("p", {}, t("session.why")),
      h("label", { for: "key" }, t("session.key")), key, fault,
      h("button", { type: "submit" }, t("session.begin"))));
    document.body.append(dialog);
    dialog.showModal();
    key.focus();
  });
  return asking;
}

// texts: a promise of what the dialog says.
export async function startSession(texts) {
  onSignedOut(async () => {
    await texts;
    await ask();
  });
  const given = location.hash.match(/^#key=(vsk_[0-9a-f]+)$/);
  if (given) {
    // The key leaves the address bar and the history at once.
    history.replaceState(null, "", "#/jobs");
    await begin(given[1]).catch(() => {});
  } else if (!document.cookie.includes(HINT) && (await json("/version")).keys) {
    // Nobody is signed in: no call that is refused.
    await signedIn();
  }
  return whoami();
}

export async function endSession() {
  await call("/v1/session", { method: "DELETE", once: true });
  document.cookie = `${HINT}; path=/; samesite=strict; max-age=0`;
  known = null;
  await ask();
}
