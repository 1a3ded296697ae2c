// Calls to the service. The session is a cookie that scripts cannot read; errors are RFC 9457 problems.

export class Fault extends Error {
  constructor(problem) {
    super(problem.detail ?? "The service did not answer as expected.");
    this.problem = problem;
  }
}

export async function call(path, options = {}) {
  let response;
  try {
    response = await fetch(path, { credentials: "same-origin", ...options });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Fault({ status: 0, code: "offline", detail: "The service does not answer. Is it running?" });
  }
  if (response.ok) return response;
  const problem = await response.json().catch(() => ({}));
  if (response.status === 401) window.dispatchEvent(new Event("signed-out"));
  throw new Fault({ status: response.status, ...problem });
}

export const json = async (path, options) => (await call(path, options)).json();

// An upload with progress, which fetch does not tell.
export function send(form, onProgress) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open("POST", "/v1/jobs");
    request.responseType = "json";
    request.upload.onprogress = (e) => e.lengthComputable && onProgress(e.loaded / e.total);
    request.onload = () =>
      request.status < 300
        ? resolve(request.response)
        : reject(new Fault(request.response ?? { detail: `The upload was refused (${request.status}).` }));
    request.onerror = () => reject(new Fault({ code: "offline", detail: "The upload broke off. Send it again." }));
    request.send(form);
  });
}

// An element with attributes and children; text is never read as HTML.
export function h(name, attributes = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (value !== null && value !== undefined && value !== false) element.setAttribute(key, value);
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return element;
}

export const bytes = (n) => (n < 1024 ? `${n} B` : n < 1048576 ? `${(n / 1024).toFixed(1)} kB` : `${(n / 1048576).toFixed(1)} MB`);
export const count = (n, one, many) => `${n} ${n === 1 ? one : many}`;
export const place = (where) => {
  const parts = Object.entries(where ?? {}).map(([key, value]) => `${key} ${Array.isArray(value) ? value.join(", ") : value}`);
  return parts.length > 0 ? ` (${parts.join(", ")})` : "";
};
export const when = (text) => (text ? new Date(text).toLocaleString() : "–");
export const number = (x, digits = 1) => (typeof x === "number" && Number.isFinite(x) ? x.toFixed(digits) : "–");
