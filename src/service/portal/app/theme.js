// Light, dark, or as the system has it.
const ORDER = [undefined, "light", "dark"];

export function applyTheme() {
  const kept = localStorage.getItem("theme");
  if (kept) document.documentElement.dataset.theme = kept;
  else delete document.documentElement.dataset.theme;
  window.dispatchEvent(new Event("theme"));
}

export function nextTheme() {
  const next = ORDER[(ORDER.indexOf(document.documentElement.dataset.theme) + 1) % ORDER.length];
  if (next) localStorage.setItem("theme", next);
  else localStorage.removeItem("theme");
  applyTheme();
}

window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => window.dispatchEvent(new Event("theme")));
