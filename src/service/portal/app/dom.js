// Elements, live regions, buttons that work and say so.
import { t } from "./text.js";

const SVG = "http://www.w3.org/2000/svg";

function fill(element, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (value !== null && value !== undefined && value !== false) element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

// An element with attributes and children; text is never read as HTML.
export const h = (name, attributes = {}, ...children) => fill(document.createElement(name), attributes, children);
export const s = (name, attributes = {}, ...children) => fill(document.createElementNS(SVG, name), attributes, children);

// Says something to those who listen instead of looking.
export function announce(text) {
  const region = document.getElementById("spoken");
  region.textContent = "";
  requestAnimationFrame(() => { region.textContent = text; });
}

// A button that is off while its work runs and tells what went wrong.
export function button(label, work, attributes = {}) {
  const element = h("button", {
    type: "button",
    ...attributes,
    onclick: async () => {
      element.disabled = true;
      try {
        await work(element);
      } catch (error) {
        if (error.name !== "AbortError") window.dispatchEvent(new CustomEvent("fault", { detail: error }));
      } finally {
        element.disabled = false;
      }
    },
  }, label);
  return element;
}

export const card = (title, ...children) => h("section", { class: "card" }, title ? h("h2", {}, title) : null, ...children);

// A scrolling region that the keyboard reaches.
export const scroll = (label, ...children) => h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": label }, ...children);

// columns: [{title, number?}]; rows: lists of cells (text or elements).
export function table(caption, columns, rows, attributes = {}) {
  const kind = (i) => (columns[i]?.number ? "number" : null);
  return scroll(caption, h("table", attributes,
    h("caption", { class: "unseen" }, caption),
    h("thead", {}, h("tr", {}, columns.map((c, i) => h("th", { scope: "col", class: kind(i) }, c.title)))),
    h("tbody", {}, rows.map((row) => (row instanceof Node ? row : h("tr", {}, row.map((cell, i) => h("td", { class: kind(i) }, cell))))))));
}

// A labelled field. The control gets an id of its own.
let fields = 0;
export function field(label, control, hint) {
  fields += 1;
  control.id ||= `field-${fields}`;
  const note = hint ? h("small", { id: `${control.id}-hint` }, hint) : null;
  if (note) control.setAttribute("aria-describedby", note.id);
  return h("div", { class: "field" }, h("label", { for: control.id }, label), control, note);
}

export const select = (options, value, onchange, attributes = {}) =>
  h("select", { ...attributes, onchange: (e) => onchange(e.target.value) },
    options.map(([key, text]) => h("option", { value: key, selected: key === value }, text)));

// Yes or no, asked in a dialog that the keyboard can leave.
export function sure(question, yes) {
  return new Promise((resolve) => {
    const dialog = h("dialog", { "aria-label": question, onclose: () => { resolve(dialog.returnValue === "yes"); dialog.remove(); } },
      h("form", { method: "dialog" }, h("p", {}, question),
        h("div", { class: "actions" },
          h("button", { value: "no", class: "quiet" }, t("action.keep")),
          h("button", { value: "yes" }, yes))));
    document.body.append(dialog);
    dialog.showModal();
  });
}

// Two flat objects or lists with the same content.
export const same = (a, b) => JSON.stringify(a) === JSON.stringify(b);

// Puts children in place only when what they show has changed, so that a button under the finger stays.
export function redraw(box, content, make) {
  const text = JSON.stringify(content);
  if (box.dataset.shown === text) return;
  box.dataset.shown = text;
  const focused = document.activeElement?.dataset?.key;
  box.replaceChildren(...[make()].flat(Infinity).filter(Boolean));
  if (focused) box.querySelector(`[data-key="${CSS.escape(focused)}"]`)?.focus();
}

const rowTexts = new WeakMap();

// Rows of a table body by key. Of a row that changed only the cells that look different are replaced, and rows that stay are not
// moved: a press on a button counts when it went down and came up on the same one.
export function redrawRows(body, items, keyOf, make) {
  const focused = document.activeElement?.dataset?.key;
  const had = new Map([...body.children].map((row) => [row.dataset.row, row]));
  const rows = items.map((item) => {
    const [key, text] = [keyOf(item), JSON.stringify(item)];
    const row = had.get(key);
    had.delete(key);
    if (row && rowTexts.get(row) === text) return row;
    const fresh = make(item);
    const kept = row ?? fresh;
    if (row) [...fresh.children].forEach((cell, i) => { if (!cell.isEqualNode(row.children[i])) row.children[i].replaceWith(cell); });
    kept.dataset.row = key;
    rowTexts.set(kept, text);
    return kept;
  });
  for (const gone of had.values()) gone.remove();
  rows.forEach((row, i) => { if (body.children[i] !== row) body.insertBefore(row, body.children[i] ?? null); });
  if (focused && document.activeElement?.dataset?.key !== focused) body.querySelector(`[data-key="${CSS.escape(focused)}"]`)?.focus();
}

// Hands a text to the browser as a file.
export function download(name, text, type) {
  const address = URL.createObjectURL(new Blob([text], { type }));
  const link = h("a", { href: address, download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), 10_000);
}
