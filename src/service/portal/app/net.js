// Calls to the service. The session is a cookie that scripts cannot read; errors are RFC 9457 problems. A call that
// meets an ended session waits for a new one and is made again, so that nothing that a user began is lost.
import { t } from "./text.js";

export class Fault extends Error {
  constructor(problem) {
    super(problem.detail ?? t("fault.unexpected"));
    this.problem = problem;
  }
}

let renew = null;
let token = null;

// Calls from now on carry this token instead of the session.
export function useToken(text) {
  token = text;
}

// Says how a new session is had: a function that resolves once there is one.
export function onSignedOut(handler) {
  renew = handler;
}

// Resolves once there is a session again.
export async function signedIn() {
  if (renew) await renew();
}

export async function call(path, options = {}) {
  for (;;) {
    let response;
    try {
      const headers = token ? { ...options.headers, authorization: `Bearer ${token}` } : options.headers;
      response = await fetch(path, { credentials: "same-origin", ...options, headers });
    } catch (error) {
      if (error.name === "AbortError") throw error;
      throw new Fault({ status: 0, code: "offline", detail: t("fault.offline") });
    }
    if (response.ok) return response;
    const problem = await response.json().catch(() => ({}));
    if (response.status === 401 && renew && !options.once) {
      await renew();
      options.signal?.throwIfAborted();
      continue;
    }
    throw new Fault({ status: response.status, ...problem });
  }
}

export const json = async (path, options) => (await call(path, options)).json();

export const post = (path, body, options = {}) =>
  call(path, {
    method: "POST",
    ...(body === undefined ? {} : { headers: { "content-type": "application/json" }, body: JSON.stringify(body) }),
    ...options,
  });

// A pause that ends early when the signal aborts.
export const pause = (ms, signal) =>
  new Promise((resolve) => {
    const timer = setTimeout(resolve, ms);
    signal?.addEventListener("abort", () => { clearTimeout(timer); resolve(); }, { once: true });
  });

// Results by address: a finished job's files never change.
const kept = new Map();

export async function lasting(path) {
  if (!kept.has(path)) {
    if (kept.size > 300) kept.delete(kept.keys().next().value);
    kept.set(path, json(path));
    kept.get(path).catch(() => kept.delete(path));
  }
  return kept.get(path);
}

export const jobPath = (id) => `/v1/jobs/${encodeURIComponent(id)}`;
export const filePath = (id, name) => `${jobPath(id)}/artefacts/${encodeURIComponent(name)}`;
