// Every text that a reader sees, by key, from text/en.json and text/de.json. A key that a language lacks falls back to
// English. `{name}` is filled in; with `n` the plural forms key.one and key.other are looked for.

export const LANGUAGES = { en: "English", de: "Deutsch" };
const tables = {};
let language = "en";

export async function loadTexts() {
  const wanted = localStorage.getItem("language") ?? navigator.language.slice(0, 2);
  language = LANGUAGES[wanted] ? wanted : "en";
  const load = async (name) => {
    tables[name] ??= await (await fetch(`/portal/${name}.json`)).json();
  };
  await Promise.all([load("en"), load(language)]);
  document.documentElement.lang = language;
}

export async function setLanguage(name) {
  localStorage.setItem("language", name);
  await loadTexts();
}

export const currentLanguage = () => language;

const find = (key) => tables[language]?.[key] ?? tables.en?.[key];

// Whether there is a text of that key.
export const has = (key) => find(key) !== undefined;

export function t(key, values = {}) {
  let text = find(key);
  if (typeof values.n === "number") text = find(`${key}.${new Intl.PluralRules(language).select(values.n)}`) ?? text ?? find(`${key}.other`);
  return (text ?? key).replace(/\{(\w+)\}/g, (whole, name) => values[name] ?? whole);
}

// The reader's own region of the chosen language: a British date in English where the system is British.
const region = () => (navigator.language.startsWith(language) ? navigator.language : language);

export function number(x, digits = 1) {
  if (typeof x !== "number" || !Number.isFinite(x)) return "–";
  const text = x.toLocaleString(region(), { minimumFractionDigits: digits, maximumFractionDigits: digits });
  return /[1-9]/.test(text) ? text.replace("-", "−") : text.replace("-", "");
}

export function signed(x, digits = 1) {
  const text = number(x, digits);
  return x > 0 && /[1-9]/.test(text) ? `+${text}` : text;
}

export const when = (text, dateStyle = "medium", timeStyle = "short") =>
  text ? new Date(text).toLocaleString(region(), { dateStyle, timeStyle }) : "–";

export const bytes = (n) => {
  const steps = [["B", 1], ["kB", 1e3], ["MB", 1e6], ["GB", 1e9]];
  const [unit, size] = steps.findLast(([, s]) => n >= s) ?? steps[0];
  return `${number(n / size, unit === "B" || n / size >= 100 ? 0 : 1)} ${unit}`;
};

export function duration(seconds) {
  if (!Number.isFinite(seconds)) return "–";
  const s = Math.max(0, Math.round(seconds));
  if (s < 60) return t("time.seconds", { s });
  if (s < 3600) return t("time.minutes", { m: Math.floor(s / 60), s: s % 60 });
  return t("time.hours", { h: Math.floor(s / 3600), m: Math.floor((s % 3600) / 60) });
}

const ROLES = ["graft", "proximal", "distal", "host_a", "host_b", "other"];

// A role's name; with the branch's number where others of the same result have that role (see `countRoles`).
export function roleName(branch) {
  if (!ROLES.includes(branch.role) || branch.role === "other") return t("role.branch", { id: branch.id });
  return branch.twins > 1 ? `${t(`role.${branch.role}`)} (${branch.id})` : t(`role.${branch.role}`);
}

// Notes in every branch how many have its role: a tree has a graft at each junction.
export function countRoles(found) {
  for (const branch of found.branches) branch.twins = found.branches.filter((b) => b.role === branch.role).length;
  return found;
}

// An angle's name in words; unknown names are put together from the branches in them.
export function angleName(name) {
  if (has(`angle.${name}`)) return t(`angle.${name}`);
  const words = ROLES.reduce((text, role) => text.replaceAll(role, t(`role.${role}`)), name);
  const put = words.replace(/_planar$/, t("angle.planar")).replace(/_normal$/, t("angle.normal")).replaceAll("_", " – ");
  return put.charAt(0).toUpperCase() + put.slice(1);
}

export const place = (where) =>
  Object.entries(where ?? {})
    .map(([key, value]) => {
      const name = has(`place.${key}`) ? t(`place.${key}`) : key;
      return Array.isArray(value) ? `${name} ${value.map((x) => number(x)).join(", ")} mm` : `${name} ${value}`;
    })
    .join(", ");
